"""Rivals on plants with outputs: those whose idea is about errors follow outputs; the others say why they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_outputs import arm, circle, hill, sedated, simulated

import fpirhc as fp
from fpirhc.errors import InvalidProblem, NotSupported


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
