"""Limits of a map hold at every step of a stage: an oscillator whose stage is a whole period hides its swing from the nodes."""

import math

import numpy as np
import pytest
from helpers.horizons import horizon_of

import fpirhc as fp

STEPS, MOST = 8, 0.5
T = 1.0 / STEPS
W = 2 * math.pi


def swung(x, u, p):
    faster = x.v + T * (u.push - W**2 * x.a)
    return {"a": x.a + T * faster, "v": faster}


PLANT = fp.Plant.discrete(
    states={"a": "m", "v": "m/s"},
    inputs={"push": "m/s^2"},
    next=swung,
    step=T,
    outputs={"a": fp.Output("m", lambda x, p: x.a)},
    parameters={"unused": fp.Parameter(1.0, 1.0, "1")},
)
STILL = fp.Trajectory(lambda t: {"a": 0 * t})
PUSHED = fp.CustomCost(lambda v: {"push": (v.input.push - 30) ** 2})
LIMITED = {
    "state": fp.Limits(states={"a": (-1.0, MOST)}),
    "path": fp.Limits(paths={"swing": fp.PathConstraint(lambda v: v.state.a, upper=MOST, unit="m")}),
    "output": fp.Limits(paths={"swing": fp.PathConstraint(lambda v: v.output.a, upper=MOST, unit="m")}),
    "priced": fp.Limits(states={"a": (-1.0, MOST)}, prices={"a": 1e6}),
}


def largest(limits: fp.Limits, lengths: tuple[float, ...] = ()) -> float:
    """Largest swing over all single steps of a plan of three stages."""
    horizon = fp.Horizon(stages=3, step=STEPS * T, lengths=lengths)
    ocp, data = horizon_of(PLANT, STILL, horizon, PUSHED, limits)
    first = np.asarray(ocp.start([0.0, 0.0], [0.0]).full()).ravel()
    own = fp.FixedPointSolver(iterations=30, tolerance=1e-6, hessian=fp.ExactHessian())
    plan = fp.solve(ocp, own if limits.prices else fp.Ipopt(accuracy=1e-9), first, data)
    assert plan.status == fp.Status.OK
    a, v, seen = 0.0, 0.0, [0.0]
    for push, length in zip(plan.inputs[0], lengths or (1,) * 3, strict=True):
        for _ in range(round(STEPS * length)):
            v += T * (push - W**2 * a)
            a += T * v
            seen.append(a)
    return max(seen)


@pytest.mark.parametrize("name", ["state", "path", "output"])
@pytest.mark.parametrize("lengths", [(), (1.0, 2.0, 1.0)], ids=["equal", "longer"])
def test_hard_limits_hold_at_every_step(name, lengths):
    """The limit is met exactly, so it is the one that binds the plan."""
    assert largest(LIMITED[name], lengths) == pytest.approx(MOST, abs=1e-6)


def test_priced_limits_hold_at_the_nodes_alone():
    assert largest(LIMITED["priced"]) > 1.5 * MOST
