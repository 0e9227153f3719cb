"""Plans that keep a margin from limits of states."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import posed

LIMIT = 0.8


def carriage(mass: float = 1.0, believed: float = 1.3) -> fp.Problem:
    """A carriage on a track that is shorter than what it is to follow."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"F": "N"},
        response=lambda q, v, u, p: {"q": (u.F - 2.0 * q.q - 0.4 * v.q) / p.m},
        parameters={"m": fp.Parameter(believed, mass, "kg")},
    )
    limits = fp.Limits(inputs={"F": (-20.0, 20.0)}, states={"q": (-LIMIT, LIMIT), "q'": (-2.5, 2.5)})
    cost = fp.Quadratic(states={"q": 100.0, "q'": 1.0}, effort={"F": 1e-3})
    more = {"limits": limits, "horizon": fp.Horizon(stages=20, step=0.05), "cost": cost, "measure_from": 1.0}
    moved = fp.Trajectory(lambda t: {"q": ca.sin(2 * t)})
    return fp.Problem(plant, moved, {"q": 0.0, "q'": 2.0}, period=0.01, duration=3.5, **more)


def test_a_margin_narrows_the_plan_by_its_number_at_every_stage():
    """On the bound less the margin where the limit is active, like IPOPT's plan with the same margin."""
    margin, problem = 0.13, carriage()
    horizon = replace(problem.horizon, margins={"q": margin})
    ocp, _, data = posed(replace(problem, horizon=horizon), time=0.3)
    first = np.asarray(ocp.start([0.55, 1.4], [0.0]).full()).ravel()
    plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-7), first, data)
    assert plan.status == fp.Status.OK
    room = LIMIT - margin - np.asarray(plan.states)[0, 1:]
    assert room.min() == pytest.approx(0.0, abs=1e-5)
    other = fp.solve(ocp, fp.Ipopt(tolerance=1e-9), first, data)
    assert plan.cost == pytest.approx(other.cost, rel=1e-4)


@pytest.mark.parametrize("weights", [{"rate": {"F": 1.0}}, {}])
def test_the_rate_of_a_plan_counts_from_the_command_without_its_shift(weights):
    """A constant force that the model lacks: with the shift in its rate, a plan would pay for it for ever and stay off."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"F": "N"},
        order=1,
        response=lambda q, u, p: {"q": u.F - q.q + p.d},
        parameters={"d": fp.Parameter(0.0, 2.0, "N")},
    )
    still, horizon = fp.Trajectory(lambda t: {"q": 0 * t}), fp.Horizon(stages=20, step=0.05)
    more = {"horizon": horizon, "cost": fp.Quadratic(states={"q": 10.0}, **weights), "duration": 6.0}
    problem = fp.Problem(plant, still, {"q": 0.0}, period=0.01, **more)
    plan = fp.RecedingHorizon(fp.FixedPointSolver(iterations=50, tolerance=1e-9), fp.Affine(-1.0))
    run = fp.simulate(problem, plan, seed=0)
    assert np.abs(run["state"][-50:, 0]).max() < 1e-6
