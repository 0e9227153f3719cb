"""The guard, cycle by cycle, against its rules written down once more in plain numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.deformation.base import against_wrappers
from fpirhc.deformation.wrappers.guarded import EVENTS

LARGEST = 50.0
SHOWN = (
    *("factor", "event", "pause", "clean", "trips", "fallback"),
    *("sign", "oscillating", "growing", "error", "fast", "slow"),
)
AFFINE, SATURATING = fp.Affine(gain=-1.6), fp.Sigmoid(gain=-1.2, scale=0.02)


@dataclass
class Rules:
    """What docs and module text say of a guard, for one coordinate."""

    map: fp.Sigmoid | fp.Affine
    factor: float = 1.0
    sign: float = 0.0
    error: float = 0.0
    fast: float = 0.0
    slow: float = 0.0
    oscillating: int = 0
    growing: int = 0
    pause: int = 0
    clean: int = 0
    trips: float = 0.0
    fallback: bool = False
    event: int = 0
    events: list[int] = field(default_factory=list)

    def cycle(self, request: float, response: float, desired: float, mapped: float) -> float:
        """The next request, of a map that would give `mapped`."""
        candidate = request + self.factor * (mapped - request)
        active = self.pause == 0 and not self.fallback
        good = np.isfinite(candidate) and np.isfinite(response)
        error = response - desired if good else 0.0
        mean = 0.9 * self.sign + 0.1 * np.sign(error * self.error)
        fast, slow = self.fast + (abs(error) - self.fast) / 20, self.slow + (abs(error) - self.slow) / 200
        limit = self.factor * self.map.largest_step()
        stuck = np.isfinite(limit) and abs(candidate - request) >= 0.5 * limit
        at_limit = self.oscillating + 1 if mean < -0.8 and stuck else 0
        growing = self.growing + 1 if mean < -0.8 and fast > 4 * slow and fast > 1e-3 * LARGEST else 0
        event = (
            4
            if not good
            else 3
            if abs(candidate - desired) > LARGEST
            else 2
            if growing > 20
            else 1
            if at_limit > 20
            else 0
        )
        trip = active and event > 0
        self.trips = self.trips * (1 - 1 / 1000) + trip
        was, self.fallback = self.fallback, self.fallback or self.trips > 2.5
        self.clean = 0 if trip else self.clean + 1
        before = self.factor
        if trip:
            self.factor *= 0.5
        elif self.clean > 1000 and self.clean % 8 == 0 and self.factor < 1:
            self.factor = min(1.0, 1.05 * self.factor)
        recovered = 6 if before < 1 <= self.factor else 0
        self.event = 5 if self.fallback and not was else event if trip else recovered
        self.events.append(self.event)
        self.pause = 10 if trip else max(self.pause - 1, 0)
        if active and not trip:
            self.sign, self.error, self.fast, self.slow = mean, error, fast, slow
            self.oscillating, self.growing = at_limit, growing
            return candidate
        self.sign = self.error = self.fast = self.slow = self.oscillating = self.growing = 0
        return desired


def desired_at(k: int) -> float:
    """A slow sine."""
    return float(0.3 + 0.1 * np.sin(0.05 * k))


def compared(map_, plant, cycles: int) -> Rules:
    """Run guard and rules side by side on response = plant(k, request); every number of every cycle is the same."""
    guard, rules = fp.Guarded(map_, largest_deformation=LARGEST), Rules(map_)
    layout = guard.memory(("q",))
    r, f, d, m = ca.SX.sym("r"), ca.SX.sym("f"), ca.SX.sym("d"), ca.SX.sym("m", layout.size)
    request, after = guard.step(r, f, d, layout.split(m))
    step = ca.Function("guard", [r, f, d, m], [request, ca.densify(layout.join(after)), map_.step(r, f, d, {})[0]])
    names = [f"guard_{n}" for n in SHOWN]
    places = [layout.slice(n).start for n in names]
    memory, asked, given, told = layout.start(), 0.3, [], []
    for k in range(cycles):
        desired = desired_at(k)
        response = plant(k, asked)
        following, after_it, mapped = step(asked, response, desired, memory)
        memory = after_it.full()[:, 0]
        asked = rules.cycle(asked, response, desired, float(mapped))
        given.append([float(following), *memory[places]])
        told.append([asked, *(float(getattr(rules, n)) for n in SHOWN)])
    np.testing.assert_allclose(given, told, rtol=1e-9, atol=1e-12)
    return rules


def test_growing_oscillation_trips_and_grows_back():
    """A plant whose gain is too large for 60 cycles: one trip or two, then more than a thousand clean cycles."""
    rules = compared(AFFINE, lambda k, r: (2.62 if 40 <= k < 140 else 0.9) * r, 1500)
    assert {2, 6} <= set(rules.events)
    assert rules.factor == 1.0


def test_oscillation_at_the_limit_trips():
    """A saturated map alternates at its step limit, by so little that growth is not watched."""
    rules = compared(
        SATURATING, lambda k, r: desired_at(k) + (5.0 if 30 <= k < 120 else 1.0) * (r - desired_at(k)), 250
    )
    assert 1 in rules.events
    assert 2 not in rules.events


@pytest.mark.parametrize("spoil", [np.nan, np.inf, 1e6], ids=str)
def test_what_is_not_finite_or_too_large_trips_at_once(spoil):
    """Three such samples end adaptation for the rest of the run; those in a pause count for nothing."""
    bad = {20, 22, 60, 100, 130}
    rules = compared(AFFINE, lambda k, r: spoil if k in bad else 0.8 * r, 160)
    number = 4 if not np.isfinite(spoil) else 3
    assert [e for e in rules.events if e] == [number, number, 5]
    assert rules.fallback


def test_trips_far_apart_are_forgotten():
    """Four trips, each some hundred cycles after the last one, do not end adaptation."""
    rules = compared(AFFINE, lambda k, r: np.nan if k % 700 == 50 else 0.9 * r, 1500)
    assert not rules.fallback
    assert rules.events.count(4) == 3


def test_alternating_errors_that_stay_small_trip_nothing():
    """Below a thousandth of the largest deformation growth is noise."""
    rules = compared(AFFINE, lambda k, r: 0.9 * r + 1e-4 * (-1.05) ** min(k, 60), 300)
    assert not any(rules.events)


def test_every_event_has_a_description():
    """Six numbers, each with words of its own."""
    assert sorted(EVENTS) == [1, 2, 3, 4, 5, 6]
    assert len(set(EVENTS.values())) == 6


@pytest.mark.parametrize(("form", "watched"), [(SATURATING, True), (fp.ModelReferenced(SATURATING), False)])
def test_oscillation_at_the_limit_is_watched_where_the_last_request_is_given(form, watched):
    """A model-referenced form is given the model's response: its distance from the next request is no step."""
    guard = fp.Guarded(form, largest_deformation=LARGEST)
    layout = guard.memory(("q",))
    f, m = ca.SX.sym("f"), ca.SX.sym("m", layout.size)
    _, after = guard.step(ca.SX(0.0), f, ca.SX(0.3), layout.split(m))
    step = ca.Function("guard", [f, m], [ca.densify(layout.join(after))])
    memory = layout.start()
    for k in range(30):
        memory = step(0.3 + 5.0 * (-1) ** k, memory).full()[:, 0]
    assert (memory[layout.slice("guard_oscillating")] > 0) == watched


@pytest.mark.parametrize("wrapper", [lambda m: fp.Guarded(m, largest_deformation=LARGEST), fp.BeyondLimit])
def test_a_wrapper_that_changes_no_pair_may_stand_around_a_model_referenced_form(wrapper):
    """A form compares the response with its own; a filter around it would change one of the two alone."""
    form = fp.ModelReferenced(fp.Affine(gain=-0.6))
    assert not list(against_wrappers(wrapper(form)))
    assert list(against_wrappers(wrapper(fp.Increment(form, cycles=0))))
