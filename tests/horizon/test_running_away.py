"""Plants that run away by themselves are planned, with states of their own and without."""

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import posed
from fpirhc.contracts import judge


def pendulum(length, horizon, limits):
    """An upright pendulum, which falls with the rate sqrt(g / length)."""
    plant = fp.Plant(
        coordinates={"a": "rad"},
        inputs={"M": "N m"},
        parameters={"g": fp.Parameter(9.81, 9.81, "m/s^2")},
        response=lambda q, v, u, p: {"a": p.g / length * ca.sin(q.a) + u.M / length**2 - 0.05 * v.a},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"a": 0 * t}),
        start={"a": 0.2},
        period=0.02,
        duration=0.6,
        limits=fp.Limits(inputs={"M": (-20.0, 20.0)}, states=limits),
        horizon=fp.Horizon(stages=round(horizon / 0.04), step=0.04),
        cost=fp.Quadratic(states={"a": 10.0, "a'": 1.0}, effort={"M": 0.01}),
    )


PLANNED = fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-4))


def test_a_plant_that_runs_away_itself_is_planned_with_states_of_its_own():
    """It multiplies a motion by 1e10 over the horizon; with limits of states the plans are those of IPOPT."""
    problem = pendulum(0.25, 4.0, {"a": (-0.5, 0.5)})
    run = fp.simulate(problem, PLANNED, seed=0)
    other = fp.simulate(problem, fp.RecedingHorizon(fp.Ipopt(tolerance=1e-8)), seed=0)
    assert set(fp.measure(problem, run).statuses) == {"OK"}
    np.testing.assert_allclose(run["state"], other["state"], atol=1e-4)


@pytest.mark.parametrize("horizon", [1.6, 3.0, 4.0])
def test_a_plant_that_runs_away_itself_is_planned_without_them(horizon):
    """Every plan, the first one too, is that of IPOPT and OK: a plan that lets the pendulum fall does not look stationary."""
    problem = pendulum(0.25, horizon, {})
    ocp, first, data = posed(problem)
    for tolerance in (1e-4, 1e-8):
        plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=tolerance), first, data)
        best = fp.solve(ocp, fp.Ipopt(tolerance=1e-8), first, data)
        assert plan.status is best.status is fp.Status.OK
        assert plan.cost == pytest.approx(best.cost, rel=1e-6)
    judged = judge(ocp)(np.zeros((1, ocp.stages)), first, data, -20.0, 20.0, np.zeros((2, ocp.stages)))
    assert float(judged[1]) > 1.0  # N m, of the plan without torque
    run = fp.simulate(problem, PLANNED, seed=0, compiled=False)
    other = fp.simulate(problem, fp.RecedingHorizon(fp.Ipopt(tolerance=1e-8)), seed=0, compiled=False)
    assert set(fp.measure(problem, run).statuses) == {"OK"}
    np.testing.assert_allclose(run["state"], other["state"], atol=1e-4)
