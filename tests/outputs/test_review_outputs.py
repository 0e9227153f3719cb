"""Reviews of plants with outputs: the linear loop of plans, and every question, against simulated runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from plants import simulated
from test_outputs import TRACK, arm, circle, curve, hill, sedated

import fpirhc as fp
from fpirhc.deformation.base import Deformation
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along

LEVEL = 3.0  # mg/l
CONVERGED = fp.RecedingHorizon(fp.FixedPoint(iterations=8, tolerance=1e-9))


def resting(**settings: Any) -> fp.Problem:
    """The depth at rest, with a wrong curve and a new plan in every cycle."""
    still = float(curve(LEVEL, 4.0))
    cost = fp.Quadratic(outputs={"depth": 1.0, "depth'": 0.1}, rate={"u": 1e-2})
    changes: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"depth": still + 0 * t}),
        "start": {"C": LEVEL, "E": LEVEL},
        "period": 0.1,
        "duration": 7.0,
        "measure_from": 0.0,
        "cost": cost,
        "horizon": fp.Horizon(stages=12, step=0.1),
        "input_before": {"u": LEVEL},
    }
    return replace(sedated(hill(5.5)), **{**changes, **settings})


@pytest.mark.parametrize("form", [fp.ModelReferenced(fp.Affine(-1.0))])
def test_the_linear_loop_of_a_plan_is_the_decay_of_a_small_deviation(form: Deformation) -> None:
    problem, controller = resting(), replace(CONVERGED, deformation=form)
    loops = loops_along(review_grid(problem, 0.0, 0), controller)
    starts = ({**problem.start, "E": LEVEL + s} for s in (1e-3, -1e-3))
    one, other = (simulated(replace(problem, start=s), controller)["output.depth"] for s in starts)
    deviation = np.abs(one - other)
    decay = (deviation[60] / deviation[30]) ** (1 / 30)
    assert loops.radii[0] == pytest.approx(decay, rel=3e-3)


def test_a_plan_on_the_hand_of_an_arm_has_a_linear_loop() -> None:
    cost = fp.Quadratic(outputs={"x": 1e3, "y": 1e3, "x'": 1.0, "y'": 1.0}, rate={"A": 1e-3, "B": 1e-3})
    problem = circle(arm(), horizon=fp.Horizon(stages=10, step=0.02), cost=cost)
    loops = loops_along(review_grid(problem, 0.0, 0), replace(CONVERGED, deformation=fp.Affine(-0.5)))
    assert loops.radii.max() < 1
    bare = loops_along(review_grid(problem, 0.0, 0), fp.ComputedTorque(TRACK))
    assert not bare.reason
