"""An absurd but finite sample does not stay in integrals, filters and queues: the run returns to the undisturbed one.

The samples reach the controller, because no range is stated here; with `Sensor(range=...)` they are skipped.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance.loops import two_masses
from fpirhc.contracts import Deformation, Tracking
from fpirhc.controllers.reference_states import largest_response
from fpirhc.simulation.loop import close_loop
from fpirhc.simulation.path import true_response
from fpirhc.symbolic.evaluate import Evaluator

PROBLEM = replace(two_masses(), duration=6.0)
PLANT = PROBLEM.plant
LAWS: dict[str, Tracking] = {
    "exponential": fp.Exponential(rate=6.0),
    "exponential, integral from zero": fp.Exponential(rate=6.0, bumpless=False),
    "exponential, no integral": fp.Exponential(rate=6.0, integral=False),
    "fractional below one": fp.Fractional(rate=6.0, order=0.8, memory=2.0),
    "fractional above one": fp.Fractional(rate=6.0, order=1.2, memory=2.0),
}
SHAPE = fp.Sigmoid(gain=-0.5, scale=50.0)
MAPS: dict[str, Deformation] = {
    "none": fp.Identity(),
    "sigmoid": SHAPE,
    "affine": fp.Affine(gain=-0.5),
    "eq 3": fp.RFPT(offset=1e5, sign=-1, gain=5e-6),
    "eq 3, vector": fp.RFPTVector(offset=1e5, sign=-1, gain=5e-6),
    "rotation": fp.Rotation(fraction=0.4, radius=1e3),
    "filtered": fp.Filtered(SHAPE, pole=0.5),
    "filtered slowly": fp.Filtered(fp.Affine(gain=-0.5), pole=0.8),
    "tuned": fp.Tuned(SHAPE, largest_gain=1.0),
    "increment": fp.Increment(SHAPE, cycles=2),
    "paired": fp.Paired(fp.Sigmoid(gain=-0.3, scale=50.0), cycles=0),
    "model-referenced": fp.ModelReferenced(SHAPE),
}
QUICK = (
    ("exponential", "sigmoid"),
    ("exponential", "filtered"),
    ("exponential, integral from zero", "increment"),
    ("fractional below one", "none"),
)
SPIKES = tuple((what, size, first) for what in ("state", "realised") for size in (1e9, -1e155) for first in (0, 200))
RETURNS = 15.0  # over the law's rate: time after which the run is back
NEAR = 2e-3  # m; the motion has 0.4 m


@dataclass(frozen=True)
class Spike:
    """One sample of a state or response of this size, in this cycle."""

    what: str
    size: float
    cycle: int


def motion(stepper: fp.Stepper, spike: Spike | None, cycles: int) -> np.ndarray:
    """Positions of the two masses, shape (cycles, 2)."""
    function = true_response(PROBLEM).function
    assert function is not None
    advance, response = Evaluator(PROBLEM.integrator.step(PLANT, PROBLEM.period)), Evaluator(function)
    memory, x, u, calm = stepper.start(), np.array(PROBLEM.start_state), np.zeros(2), np.zeros(2)
    positions = []
    for k in range(cycles):
        sample = {"state": x, "realised": response(x, u, PLANT.exact, calm)[0]}
        if spike is not None and k == spike.cycle:
            sample[spike.what] = np.full_like(sample[spike.what], spike.size)
        u, memory = stepper.step(k * PROBLEM.period, sample["state"], sample["realised"], memory)
        (x,) = advance(x, u, PLANT.exact, calm)
        positions.append(x[:2])
    return np.array(positions)


def stays_away(law: Tracking, deformation: Deformation) -> dict[str, float]:
    """Distance to the undisturbed motion after the stated time, of every spike where it is too large."""
    stepper = fp.Stepper(PROBLEM, fp.ComputedTorque(law, deformation), compiled=False)
    assert law.speed is not None
    back, after = round(RETURNS / law.speed / PROBLEM.period), 20
    cycles = 200 + back + after
    clean, far = motion(stepper, None, cycles), {}
    for what, size, first in SPIKES:
        end = first + back
        rest = np.abs(motion(stepper, Spike(what, size, first), end + after) - clean[: end + after])[end:].max()
        if not rest < NEAR:
            far[f"{what} {size:g} in cycle {first}"] = float(rest)
    return far


@pytest.mark.parametrize(("law", "deformation"), QUICK)
def test_a_run_returns_after_a_spike(law, deformation):
    """Within 15 / rate, to half a per cent of the motion."""
    assert stays_away(LAWS[law], MAPS[deformation]) == {}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("deformation", MAPS)
def test_a_run_returns_after_a_spike_with_every_law_and_map(law, deformation):
    assert stays_away(LAWS[law], MAPS[deformation]) == {}


def test_without_its_bound_the_law_does_not_return():
    """The test above can fail: a law that is told that anything is possible keeps the first spike in its integral."""
    unbounded = fp.Exponential(rate=6.0, largest=(np.inf, np.inf))
    assert "state 1e+09 in cycle 0" in stays_away(unbounded, SHAPE)


def test_the_largest_response_is_that_of_the_limits():
    """Q'' of either mass by its own force alone, and the model's coupling, at one place along the reference, rounded up."""
    largest = largest_response(PROBLEM)
    reference = PROBLEM.reference.function(PLANT)
    sizes = []
    for t in np.linspace(0.0, PROBLEM.duration, 100):
        x = np.asarray(reference(t)[0].full()).ravel()
        corners = [(a, b) for a in PROBLEM.limits.inputs["Fa"] for b in PROBLEM.limits.inputs["Fb"]]
        sizes.append([np.asarray(PLANT.equations.controlled_response(x, u, PLANT.approximate).full()) for u in corners])
    # The two forces act on their own masses alone here, so the bound is attained to the spread of the samples.
    assert np.abs(sizes).max(axis=(0, 1)).ravel() * 2 ** (1 / 16) == pytest.approx(np.array(largest), rel=0.05 + 1 / 16)
    assert (np.abs(sizes).max(axis=(0, 1)).ravel() <= np.array(largest) * (1 + 1e-9)).all()
    free = replace(PROBLEM, limits=fp.Limits(inputs={"Fa": (-30.0, 30.0)}))
    assert largest_response(free) == (np.inf, np.inf)


def test_the_largest_response_is_computed_once_for_a_loop(monkeypatch):
    """Law, update and map have the same bound, and one evaluation along the reference."""
    evaluations: list[fp.Problem] = []
    module = sys.modules[largest_response.__module__]
    states = module._states

    def counted(task: fp.Problem) -> np.ndarray:
        evaluations.append(task)
        return states(task)

    monkeypatch.setattr(module, "_states", counted)
    close_loop(replace(PROBLEM, duration=1.0), fp.ComputedTorque(fp.Exponential(rate=6.0), SHAPE))
    assert len(evaluations) == 1
