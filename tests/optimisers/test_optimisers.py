"""Optimisers: every plan is stationary or says that it is not; all find the same optimum."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.horizons import horizon_of, repeated
from helpers.plants import known

import fpirhc as fp
from fpirhc.contracts import judge

SHIPPED: Any = tasks  # whose horizons and controllers are of known kinds
GRADIENT = fp.ReducedGradient(iterations=60, tolerance=1e-4)
BACKENDS = (fp.Ipopt(), fp.Fatrop())
FIXED = fp.FixedPointSolver(iterations=8, tolerance=1e-6)
EVERY: tuple[Any, ...] = (GRADIENT, FIXED, *BACKENDS)
BOXES = {
    "free": fp.Limits(),
    "active": fp.Limits(inputs={"Q1": (-5.0, 10.0), "Q2": (-30.0, 30.0)}),
    "all active": fp.Limits(inputs={"Q1": (-5.0, 10.0), "Q2": (-30.0, -15.0)}),
}
ids = [type(o).__name__ for o in EVERY]


def two_mass(limits):
    """(ocp, data, first state) of the shipped problem's first horizon."""
    p = SHIPPED.two_mass.problem
    ocp, data = horizon_of(p.plant, p.reference, p.horizon, p.cost, limits)
    return ocp, data, p.start_state


@pytest.mark.parametrize("limits", BOXES.values(), ids=BOXES)
@pytest.mark.parametrize("optimiser", EVERY, ids=ids)
def test_all_find_the_same_stationary_plan(optimiser, limits):
    """Same cost to 1e-6, and the plan's own verification agrees with what the optimiser told."""
    ocp, data, first = two_mass(limits)
    plan = fp.solve(ocp, optimiser, first, data)
    best = fp.solve(ocp, fp.Ipopt(), first, data)
    assert plan.status == fp.Status.OK
    assert plan.cost == pytest.approx(best.cost, rel=1e-6)
    cost, stationarity, feasibility = plan.verify()
    assert (cost, stationarity, feasibility) == pytest.approx((plan.cost, plan.stationarity, 0.0), rel=1e-9, abs=1e-12)
    assert stationarity <= 1e-3
    assert np.all(plan.inputs.min(axis=1) >= ocp.input_lower)
    assert np.all(plan.inputs.max(axis=1) <= ocp.input_upper)


def test_a_time_limit_ends_a_solve():
    """What is found until then is not called solved."""
    ocp, data, first = two_mass(None)
    assert fp.solve(ocp, fp.Ipopt(time_limit=1e-6), first, data, calls=1).status == fp.Status.NOT_CONVERGED


def test_bounds_of_the_plan_are_shifted_by_the_correction():
    """The deformation takes part of the actuator, so the plan gets the rest: planned + correction stays inside."""
    tight = replace(
        SHIPPED.two_mass.problem,
        limits=fp.Limits(inputs={"Q1": (-60.0, 10.0), "Q2": (-60.0, 40.0)}),
        duration=2.0,
        measure_from=0.5,
    )
    run = fp.simulate(tight, fp.RecedingHorizon(GRADIENT, fp.Sigmoid(gain=-0.5, scale=20.0)), seed=0)
    assert run["command.Q1"].max() <= 10.0
    fresh = np.arange(10, run.cycles, 10)
    meant = run["planned.Q1"][fresh] + run["command_shift.Q1"][fresh - 1]
    assert meant.max() <= 10.0 + 1e-6
    assert meant.max() > 9.9


def broken(ocp, data, first):
    """Arguments that no optimiser can serve, and the status that says why."""
    lower, upper = ocp.input_lower, ocp.input_upper
    massless = np.asarray(ca.DM(data).full()).copy()
    massless[ocp.data.slice("parameters").start] = 0.0
    return {
        "state is NaN": ((first * np.nan, data, lower, upper), fp.Status.NON_FINITE),
        "state overflows": ((first + 1e200, data, lower, upper), fp.Status.NON_FINITE),
        "data is NaN": ((first, data * np.nan, lower, upper), fp.Status.NON_FINITE),
        "model divides by zero": ((first, massless, lower, upper), fp.Status.NON_FINITE),
        "bound is NaN": ((first, data, lower * np.nan, upper), fp.Status.NON_FINITE),
        "box is empty": ((first, data, upper + 1.0, upper), fp.Status.INFEASIBLE),
    }


@pytest.mark.parametrize("optimiser", EVERY, ids=ids)
def test_broken_problems_are_statuses_and_leave_no_trace(optimiser, capfd):
    """Nothing raises, nothing is printed, nothing that is not finite is returned; the next good problem is solved."""
    ocp, data, first = two_mass(BOXES["active"])
    step, start = optimiser.step(ocp), optimiser.memory(ocp).start()
    bounds = (ocp.input_lower, ocp.input_upper)
    good, _, warm = step(first, data, *bounds, start)
    for name, (arguments, status) in broken(ocp, data, first).items():
        inputs, diagnostics, memory = step(*arguments, warm)
        assert int(diagnostics[4]) == status, name
        assert np.isfinite(inputs.full()).all(), name
        assert np.isfinite(memory.full()).all(), name
        assert name != "state is NaN" or np.allclose(inputs.full(), good.full(), rtol=0, atol=1e-12)
        for _ in range(3):
            _, diagnostics, memory = step(first, data, *bounds, memory)
        assert int(diagnostics[4]) == fp.Status.OK, name
    assert capfd.readouterr().out == ""


RIDING = {
    "upper": fp.Limits(inputs={"Q1": (-40.0, 60.0)}, states={"q1'": (-0.3, 0.4), "q1": (2.1, 2.4)}),
    "lower": fp.Limits(inputs={"Q1": (-40.0, 60.0)}, states={"q2'": (-0.3, 2.0)}),
}


@pytest.mark.parametrize("side", RIDING)
@pytest.mark.parametrize("optimiser", BACKENDS, ids=ids[2:4])
def test_multipliers_of_state_limits_are_verified_without_the_solver(optimiser, side):
    """verify() fits its own multipliers of the right sign and finds the plan stationary; without them it is not."""
    ocp, data, _ = two_mass(RIDING[side])
    plan = fp.solve(ocp, optimiser, np.array([2.25, 5.6, 0.2, -0.1]), data)
    assert plan.status == fp.Status.OK
    assert plan.verify()[1] < 1e-3
    multipliers = plan.state_multipliers if side == "upper" else -plan.state_multipliers
    bound = ocp.state_upper if side == "upper" else ocp.state_lower
    active = multipliers != 0
    assert active.any()
    assert multipliers.min() >= 0
    np.testing.assert_allclose(plan.states[:, 1:][active], np.tile(bound[:, None], ocp.stages)[active], atol=1e-4)
    for wrong in (0.0, -1.0):
        values = wrong * plan.state_multipliers
        _, residual, _ = judge(ocp)(plan.inputs, plan.states[:, 0], data, ocp.input_lower, ocp.input_upper, values)
        assert float(residual) > 1.0
    _, (again, _) = repeated(optimiser, ocp, data, plan.states[:, 0], 2)
    left = 1e-9 if optimiser.plugin == "ipopt" else 1e-2  # fatrop takes no multipliers
    np.testing.assert_allclose(again, plan.inputs, rtol=0, atol=left)


def test_a_first_state_outside_its_limits_is_infeasible():
    """Too far out to come back within one stage."""
    ocp, data, _ = two_mass(RIDING["upper"])
    plan = fp.solve(ocp, fp.Ipopt(), np.array([2.6, 5.6, 0.2, -0.1]), data)
    assert plan.status == fp.Status.INFEASIBLE
    assert known(plan.feasibility) > 1e-2
    assert "iterations unknown in" in repr(plan)
    assert plan.verify()[2] == pytest.approx(plan.feasibility)
