"""What cannot be kept is named with its reason: a double integrator |u| <= 1 m/s2, whose best braking is known by hand."""

from typing import Any

import numpy as np
import pytest
from helpers.horizons import horizon_of

import fpirhc as fp

SLEDGE = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={"m": fp.Parameter(1.0, 1.0, "kg")},
    response=lambda q, v, u, p: {"y": u.u / p.m},
)


def plan_of(start: tuple[float, float], states: dict[str, tuple[float, float]], stages: int, **more: Any) -> fp.Plan:
    """The plan from (y, y') towards y = 0."""
    reference = fp.Trajectory(lambda t: {"y": 0 * t})
    horizon = fp.Horizon(stages=stages, step=0.1)
    cost = fp.Quadratic(states={"y": 1.0, "y'": 0.1}, effort={"u": 0.01})
    limits = fp.Limits(inputs={"u": (-1.0, 1.0)}, states=states, **more)
    ocp, data = horizon_of(SLEDGE, reference, horizon, cost, limits)
    first = np.asarray(ocp.start(list(start), [0.0]).full()).ravel()
    return fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-7), first, data)


OUT_OF_REACH = {  # first state, limits of y, stages, the limit, the largest violation in m
    "too fast to stop": ((0.9, 1.0), (-5.0, 1.0), 25, "above 1", 0.4),  # full braking stops at 1.4 m after 1 s
    "outside at rest": ((1.3, 0.0), (-5.0, 1.0), 25, "above 1", 0.295),  # after one stage of full braking
    "a far limit": ((0.0, 0.0), (3.0, 4.0), 5, "below 3", 2.995),
}


@pytest.mark.parametrize(("start", "limits", "stages", "limit", "most"), OUT_OF_REACH.values(), ids=OUT_OF_REACH)
def test_what_cannot_be_kept_is_named_by_how_much(start, limits, stages, limit, most):
    """Full braking, known by hand, is the plan of least violation, which four more calls do not lower; the worst stage is named."""
    plan = plan_of(start, {"y": limits}, stages)
    assert (plan.status, plan.calls) == (fp.Status.INFEASIBLE, 5)
    violations = plan.violations()
    assert limit in " ".join(violations)
    values = [float(text.partition(" is ")[2].split()[0]) for text in violations if "at stage 0" not in text]
    bound = next(v for v in limits if f" {v:g}" in limit)
    assert max(abs(value - bound) for value in values) == pytest.approx(most, abs=1e-3) == plan.verify()[2]
    assert "soften state limits, or lengthen the horizon" in plan.status.remedy


def test_a_price_lets_the_plan_pass_and_come_back():
    plan = plan_of((0.9, 1.0), {"y": (-5.0, 1.0)}, 25, prices={"y": 1e2})
    assert plan.status == fp.Status.OK
    assert plan.violations() == ()
    assert plan.states[0, 10] == pytest.approx(1.4, abs=1e-3)
    assert plan.states[0, 20:].max() < 1.0 + 1e-3
