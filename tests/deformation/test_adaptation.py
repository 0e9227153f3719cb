"""Tuning and guarding of a deformation on line: the gain finds its place, and a loop that left its basin comes back."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.deformation.wrappers.guarded import EVENTS
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.evaluate import Evaluator


@cache
def stepping(deformation, size=1):
    """Function (request, response, desired, memory) -> (request, memory) and the memory's layout."""
    layout = deformation.memory(tuple(f"q{k}" for k in range(size)))
    symbols = [ca.SX.sym(n, size) for n in ("r", "f", "d")] + [ca.SX.sym("m", layout.size)]
    request, next_memory = deformation.step(*symbols[:3], layout.split(symbols[3]))
    return ca.Function("step", symbols, [ca.densify(request), ca.densify(layout.join(next_memory))]), layout


class Scalar:
    """A map of one coordinate with its memory, through buffers: thousands of cycles take no time."""

    def __init__(self, deformation):
        function, self.layout = stepping(deformation)
        self._step = Evaluator(function)
        self._step.arguments[3][:] = self.layout.start()

    def __call__(self, *values):
        """The next request, from request, response and desired response."""
        for argument, value in zip(self._step.arguments, values, strict=False):
            argument[0] = value
        self._step.evaluate()
        self._step.arguments[3][:] = self._step.results[1]
        return float(self._step.results[0][0])

    @property
    def memory(self):
        return self._step.results[1].copy()


def run(deformation, plant, desired, noise=None):
    """Requests, true response errors and memories of the scalar loop f = plant(k, r)."""
    step, request = Scalar(deformation), float(desired[0])
    errors, requests, memories = [], [], []
    for k in range(1, len(desired)):
        response = plant(k, request)
        errors.append(response - desired[k])
        request = step(request, response + (noise[k] if noise is not None else 0.0), desired[k])
        requests.append(request)
        memories.append(step.memory)
    return np.array(requests), np.array(errors), np.array(memories), step.layout


CYCLES = 4500
SMOOTH = np.sin(0.01 * np.arange(CYCLES))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_tuner_follows_a_plant_whose_gain_jumps(noise):
    """1.2 -> 15 -> 0.3: the rms response error stays below 0.14 in each regime; a fixed gain cycles in the second."""
    gains = np.repeat([1.2, 15.0, 0.3], CYCLES // 3)
    white = noise * np.random.default_rng(0).standard_normal(CYCLES)
    sigmoid = fp.Sigmoid(gain=-0.5, scale=10.0)
    tuned = fp.Tuned(sigmoid, largest_gain=1.69 * sigmoid.slope)
    results = {}
    for deformation in (sigmoid, tuned):
        _, errors, _, _ = run(deformation, lambda k, r: gains[k] * r, SMOOTH, white)
        results[deformation] = [np.sqrt(np.mean(part[500:] ** 2)) for part in np.split(errors[: CYCLES - 3], 3)]
    assert max(results[tuned]) < 0.14
    assert results[sigmoid][1] > 10


def test_tuner_never_exceeds_its_cap():
    """Where the plant answers weakly, the factor ends at the cap and not beyond."""
    tuned = fp.Tuned(fp.Affine(gain=-0.5), largest_gain=0.8)
    _, _, memories, layout = run(tuned, lambda k, r: 0.05 * r, SMOOTH)
    factor = memories[:, layout.slice("tuner_factor")].ravel()
    assert factor.max() == pytest.approx(0.8 / 0.25)


def test_tuner_recovers_from_a_number_that_is_none():
    step, layout = stepping(fp.Tuned(fp.Affine(gain=-0.5), largest_gain=0.8))
    memory = layout.start()
    for response in (1.0, np.nan, 1.0, 1.0, 1.0):
        _, memory = step(0.0, response, 0.5, memory)
    assert np.isfinite(memory.full()).all()


@pytest.mark.parametrize("largest", [0.1, -1.0, float("inf"), float("nan")])
def test_tuner_needs_a_bound(largest):
    """A tuner without a bound is refused, and told where one comes from."""
    with pytest.raises(InvalidValue, match=r"sector_limit gives one|expected a number, got nan"):
        fp.Tuned(fp.Affine(gain=-0.5), largest_gain=largest)


def test_guard_ends_over_gained_runs_bounded():
    """40 random plants with up to ten times too much gain: recovered, or in the stated fallback; all requests finite."""
    random = np.random.default_rng(1)
    recovered = fallen = 0
    for _ in range(40):
        plant_gain, offset = random.uniform(1.0, 3.0), random.uniform(-1, 1)
        gain = random.uniform(2.2, 20.0) / plant_gain
        sigmoid = fp.Sigmoid(gain=-1.0, scale=float(random.uniform(0.5, 5.0)))
        guarded = fp.Guarded(sigmoid.with_effective_gain(gain), largest_deformation=100.0)
        requests, errors, memories, layout = run(
            guarded, lambda k, r, g=plant_gain, o=offset: g * r + o + 0.1 * np.sin(r), SMOOTH[:900]
        )
        assert np.isfinite(requests).all()
        assert np.abs(requests).max() <= 102
        fallback = memories[-1, layout.slice("guard_fallback")][0] > 0.5
        settled = np.sqrt(np.mean(errors[-100:] ** 2)) < 0.2
        assert fallback or settled
        recovered, fallen = recovered + (not fallback), fallen + fallback
    assert recovered > 7
    assert fallen > 2


@pytest.mark.parametrize("map_", [fp.Affine(gain=-2.0), fp.Sigmoid(gain=-1.0, scale=20.0).with_effective_gain(1.0)])
def test_damper_stops_an_over_gained_loop(map_):
    """A lambda = 2.5: alone it diverges or cycles at its step limit, damped it stays near the limit of stability (rms 0.008)."""
    damped, errors, memories, layout = run(fp.Damped(map_), lambda k, r: 2.5 * r + 0.3, SMOOTH[:3000])
    assert np.isfinite(damped).all()
    assert np.abs(errors).max() < 5
    assert np.sqrt(np.mean(errors[500:] ** 2)) < 0.02
    assert 2.5 * memories[500:, layout.slice("damper_factor")].mean() < 2.2
    _, alone, _, _ = run(map_, lambda k, r: 2.5 * r + 0.3, SMOOTH[:300])
    assert np.abs(alone[-10:]).max() > 10


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_damper_leaves_a_well_gained_loop_alone(share):
    """Bit for bit the same requests as without it, along a smooth task and over steps of a disturbance."""
    map_ = fp.Sigmoid(gain=-1.0, scale=20.0).with_effective_gain(share / 1.4)
    steps = np.repeat(np.random.default_rng(2).uniform(-10, 10, size=30), 40)
    desired = SMOOTH[: steps.size]
    plain, _, _, _ = run(map_, lambda k, r: 1.4 * r + steps[k], desired)
    damped, _, memories, layout = run(fp.Damped(map_), lambda k, r: 1.4 * r + steps[k], desired)
    assert np.array_equal(plain, damped)
    assert np.all(memories[:, layout.slice("damper_factor")] == 1.0)


@pytest.mark.parametrize(("product", "lowest"), [(0.5, 0.99), (1.0, 0.95), (1.8, 0.5)])
def test_damper_hears_little_in_white_noise(product, lowest):
    """Mean factor over 4500 noisy cycles at a lambda = 0.5, 1 and 1.8: measured 1.00, 1.00 and 0.69."""
    noise = np.random.default_rng(0).standard_normal(CYCLES)
    _, _, memories, layout = run(fp.Damped(fp.Affine(gain=-2.0)), lambda k, r: product * r, 0 * SMOOTH, noise)
    assert memories[:, layout.slice("damper_factor")].mean() > lowest


def test_damper_regrows_to_the_own_gain_and_not_beyond():
    """After an over-gained spell the factor comes back to one, slowly, and stays there."""
    gains = np.where(np.arange(CYCLES) < 500, 5.0, 0.8)
    _, _, memories, layout = run(fp.Damped(fp.Affine(gain=-1.0)), lambda k, r: gains[k] * r, SMOOTH)
    factor = memories[:, layout.slice("damper_factor")].ravel()
    assert factor.min() < 0.9
    assert factor[-1] == 1.0
    assert factor.max() == 1.0
    assert np.max(factor[1:] / factor[:-1]) < 1.002


@pytest.mark.parametrize("map_", [fp.Sigmoid(gain=-1.5, scale=20.0), fp.Affine(gain=-1.0)])
def test_guard_is_quiet_on_disturbance_steps(map_):
    """100 steps of random size and sign, with noise: not one trip, and the same requests as without the guard."""
    random = np.random.default_rng(2)
    steps = np.repeat(random.uniform(-10, 10, size=100), 40)
    noise = 0.05 * random.standard_normal(steps.size)
    desired = np.sin(0.01 * np.arange(steps.size))
    guarded = fp.Guarded(map_, largest_deformation=1000.0)
    plain, _, _, _ = run(map_, lambda k, r: 1.4 * r + steps[k], desired, noise)
    watched, _, memories, layout = run(guarded, lambda k, r: 1.4 * r + steps[k], desired, noise)
    assert not memories[:, layout.slice("guard_event")].any()
    np.testing.assert_allclose(watched, plain, atol=1e-12)


@pytest.mark.parametrize(("event", "spoil"), [(3, lambda r: -500.0), (4, lambda r: np.nan)])
def test_guard_tells_what_happened(event, spoil):
    """A response from nowhere and one that is not a number: the event's number, a pause on the desired response, recovery."""
    guarded = fp.Guarded(fp.Affine(gain=-1.0), largest_deformation=50.0)
    desired = np.full(2200, 1.0)
    requests, _, memories, layout = run(guarded, lambda k, r: spoil(r) if k == 100 else 1.3 * r, desired)
    events = memories[:, layout.slice("guard_event")].ravel()
    assert events[99] == event
    assert event in EVENTS
    assert np.all(requests[99:109] == 1.0)
    assert 6 in events
    assert requests[-1] == pytest.approx(1 / 1.3)
    factor = memories[:, layout.slice("guard_factor")].ravel()
    assert factor[99] == 0.5
    assert factor[-1] == 1.0


def test_events_are_logged_in_a_run():
    task = fp.load_problem("two_mass")
    from dataclasses import replace

    problem = replace(task.problem, duration=2.0, measure_from=1.0)
    wild = fp.Sigmoid(gain=-30.0, scale=20.0)
    run_ = fp.simulate(
        problem, fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Guarded(wild, 500.0)), seed=0, compiled=None
    )
    assert run_.stop is None
    assert run_["adaptation_event"].max() > 0
    tuned = fp.Tuned(fp.Sigmoid(gain=-0.5), largest_gain=0.8)
    calm = fp.simulate(
        problem, fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Guarded(tuned, 500.0)), seed=0, compiled=None
    )
    assert not calm["adaptation_event"].any()
    assert calm["gain_factor"].max() > 1.0
    assert np.abs(calm["error"][1500:]).max() < 0.01
