"""Move blocking, and the terminal weight of costs on rates."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import horizon_of, rolled
from helpers.plants import known, pendulum

import fpirhc as fp

PLANT, REFERENCE = pendulum(), fp.Trajectory(lambda t: {"angle": ca.sin(2 * t)})
COST = fp.Quadratic(states={"angle": 10.0, "angle'": 0.1}, effort={"torque": 0.05})
LIMITS = fp.Limits(inputs={"torque": (-20.0, 20.0)}, states={"angle'": (-0.4, 1.5)})
BLOCKS = (1, 1, 2, 4, 4)
HORIZON = fp.Horizon(stages=12, step=0.05)


def horizon(blocks, limits=LIMITS):
    one = replace(HORIZON, blocks=blocks)
    return horizon_of(PLANT, REFERENCE, one, COST, limits)


@pytest.mark.parametrize("limits", [fp.Limits(inputs=LIMITS.inputs), LIMITS], ids=["inputs", "states"])
def test_inputs_are_held_over_blocks_at_the_best_values(limits):
    """The plan is constant in every block, and is the best such plan of the horizon without blocks, found by scipy."""
    from scipy.optimize import minimize

    ocp, data = horizon(BLOCKS, limits)
    first = ocp.start([0.4, 0.0], [0.0]).full().ravel()
    plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-7), first, data)
    assert plan.status == fp.Status.OK
    ends = np.cumsum(BLOCKS)
    parts = np.split(plan.inputs[0], ends[:-1])
    assert max(np.ptp(part) for part in parts) < 1e-6
    free, free_data = horizon((), limits)

    def cost(values):
        return rolled(free, [0.4, 0.0], np.repeat(values, BLOCKS)[None], free_data).cost

    def inside(values):
        speeds = rolled(free, [0.4, 0.0], np.repeat(values, BLOCKS)[None], free_data).states[1, 1:]
        low, high = (v[1] for v in (free.state_lower, free.state_upper))
        return np.concatenate([speeds - low, high - speeds]) if np.isfinite(high) else np.ones(1)

    rows = {"type": "ineq", "fun": inside}
    best = minimize(cost, np.zeros(5), method="SLSQP", constraints=rows, options={"ftol": 1e-13, "maxiter": 300})
    assert plan.cost == pytest.approx(best.fun, rel=1e-6)
    without = fp.solve(free, fp.FixedPointSolver(iterations=1, tolerance=1e-7), np.array([0.4, 0.0]), free_data)
    assert known(plan.cost) > known(without.cost)
