"""Rivals on plants with outputs: those whose idea is about errors follow outputs; the others say why they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_outputs import arm, circle, hill, sedated, simulated

import fpirhc as fp
from fpirhc.controllers.contract import Controller
from fpirhc.errors import InvalidProblem, NotSupported

ON_DEPTH: dict[str, tuple[Controller, float]] = {
    "PID": (fp.PID({"depth": -2.0}, {"depth": -0.6}, {"depth": -2.0}), 1.0),
    "sliding": (fp.rivals.SlidingMode(rate=1.0, gain=2.0, width=0.5), 0.3),
    "rate": (fp.rivals.ResolvedAccelerationRate(rate=1.0), 0.1),
    "feedback": (fp.rivals.AccelerationFeedback(fp.Exponential(rate=1.0), gain=2.0, time_constant=0.2), 0.1),
    "backstepping": (fp.rivals.BacksteppingMRAC(1.0, (1.0, 1.0), fp.Affine(-1.5)), 0.1),
    "force": (fp.rivals.ForceMRAC(fp.Exponential(rate=1.0), fp.Affine(-0.5)), 0.02),
    "Lyapunov": (fp.rivals.LyapunovMRAC(rate=1.0, adaptation=0.1), 0.03),
}


@pytest.mark.parametrize("name", ON_DEPTH)
def test_a_rival_follows_an_output_of_a_wrong_curve(name: str) -> None:
    """The depth falls from 74 to 40; the errors are those of tuned rivals, rms from 3 min on."""
    controller, largest = ON_DEPTH[name]
    problem = sedated(hill(5.5), input_before={"u": 1.5})
    run = simulated(problem, controller)
    assert run.stop is None
    assert fp.measure(problem, run).rms_error["depth"] < largest


def test_an_increment_by_hand_on_the_hand_of_an_arm() -> None:
    """The first request after a step of the model: its response to the last command plus the change, less its own drift."""
    problem = replace(circle(arm()), duration=0.1, measure_from=0.0)
    run = simulated(problem, fp.rivals.ResolvedAccelerationRate(rate=6.0))
    plant, k, p, size = problem.plant, 20, [1.4], 1e-6
    respond, x, u = plant.equations.controlled_response, run["state"][k], run["command"][k - 1]
    moved = plant.equations.rate(x, u, p).full().ravel()
    ends = [respond(x + s * size * moved, u, p).full().ravel() for s in (1, -1)]
    drift = (ends[0] - ends[1]) / (2 * size)
    change = run["desired"][k] - run["realised"][k]
    request = respond(x, u, p).full().ravel() + change - problem.period * drift
    assert np.allclose(run["command"][k], plant.equations.inverse(x, request, p).full().ravel(), atol=1e-6)


@pytest.mark.parametrize("name", ["AID", "Slotine-Li"])
def test_learning_inverse_dynamics_of_other_outputs_says_why_not(name: str) -> None:
    with pytest.raises(NotSupported, match=r"mechanics in its own coordinates.* x, y are other functions of the state"):
        simulated(circle(arm()), fp.load_problem("planar_arm").controllers[name])


def test_gains_are_named_by_outputs() -> None:
    with pytest.raises(InvalidProblem, match="controlled coordinate 'deep' is unknown"):
        simulated(sedated(hill(5.5)), fp.PID({"deep": -1.0}))
    with pytest.raises(InvalidProblem, match="has relative order 2, but rates has 1"):
        simulated(sedated(hill(5.5)), fp.rivals.BacksteppingMRAC(1.0, (1.0,), fp.Affine(-1.0)))
