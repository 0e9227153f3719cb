"""Optimisers: every plan is stationary or says that it is not; all find the same optimum, on the shipped problems too."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.horizons import COST, horizon_of, linear_problem, pendulum_problem, repeated
from helpers.kinds import slow_but
from helpers.plants import known

import fpirhc as fp
from fpirhc.conformance import posed
from fpirhc.contracts import judge, reduced_gradient
from fpirhc.errors import CompileError, InvalidValue, NotContractive, NotInstalled, NotSupported

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


# The shipped problems
PROBLEMS = ("two_mass", "van_der_pol", "cart_pole", "two_link_arm", "chain_of_masses")


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_same_optimum_as_ipopt(name, share):
    """Cost to 1e-6 and inputs to 1e-5 of their range, with the problem's limits and with tighter ones."""
    ocp, first, data = posed(fp.load_problem(name).problem)
    middle, half = (ocp.input_upper + ocp.input_lower) / 2, (ocp.input_upper - ocp.input_lower) / 2
    ocp = replace(ocp, input_lower=middle - share * half, input_upper=middle + share * half)
    scale = float(half.max())
    plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-8 * scale), first, data)
    # IPOPT starts where the other ended: a swing-up has several local optima.
    other = fp.solve(ocp, fp.Ipopt(tolerance=1e-6 * scale, accuracy=1e-11), first, data, start=plan.inputs, calls=3)
    assert plan.status == fp.Status.OK
    assert plan.cost == pytest.approx(other.cost, rel=1e-6)
    np.testing.assert_allclose(plan.inputs, other.inputs, atol=1e-5 * scale)


@pytest.mark.parametrize("name", slow_but(PROBLEMS, "two_mass"))
def test_one_iteration_per_cycle_is_as_good_as_converged_solving(name):
    """The closed-loop cost is within 1 %, with and without adaptation."""
    task = fp.load_problem(name)
    duration = min(task.problem.duration, 2.5)
    problem = replace(task.problem, duration=duration, measure_from=min(task.problem.measure_from, duration / 2))
    if name == "cart_pole":  # tracking with the pole up: a swing-up has several local optima, and each may find another
        problem = replace(problem, start={"cart": 0.2, "angle": 0.2})
    whole = replace(problem, measure_from=0.0)
    for controller in ("RHC", "RHC+FPI"):
        once: Any = task.controllers[controller]
        costs = []
        for selection in (once, replace(once, optimiser=replace(once.optimiser, iterations=12))):
            run = fp.simulate(problem, selection, seed=0)
            assert run.stop is None
            costs.append(fp.measure(whole, run)["cost"]["total"])
        assert costs[0] <= 1.01 * costs[1]


def test_a_first_plan_at_its_limits_alone_is_sought_again():
    """A valve of the tanks 10 % off: from no input the search ends at an empty tank, in which no pump has an effect."""
    task = fp.load_problem("leaking_tanks")
    valves = dict(task.problem.plant.parameters)
    valves["s2"] = replace(valves["s2"], approximate=4.4e-5)
    problem = replace(task.problem, plant=replace(task.problem.plant, parameters=valves), duration=60.0)
    ocp, first, data = posed(problem)
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-6)
    empty = fp.solve(ocp, optimiser, first, data, start=np.zeros((1, ocp.stages)))
    assert empty.status == fp.Status.OK
    assert not empty.inputs.any()
    found = fp.solve(ocp, optimiser, first, data)
    assert found.cost == pytest.approx(fp.solve(ocp, fp.Ipopt(tolerance=1e-6), first, data).cost, rel=1e-6)
    assert found.cost < 1e-3 * empty.cost
    run = fp.simulate(problem, task.controllers["RHC"], seed=0, compiled=False)
    assert run["command"].min() > 40.0
    assert fp.measure(problem, run).rms_error["h2"] < 0.03


# The published optimiser and its reduced form: what they promise, and why the default is another one
FIRST = np.array([0.5, -0.5])


@pytest.mark.parametrize("high", [100.0, 1.0])
def test_the_reduced_form_finds_the_same_optimum(high):
    """Slower than the default, and the same plan, bounds active or not."""
    ocp, data = pendulum_problem(limits=fp.Limits(inputs={"torque": (-high, high)}))
    plan = fp.solve(ocp, fp.GradientFixedPoint(iterations=400, tolerance=1e-7), FIRST, data)
    best = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-8), FIRST, data)
    assert plan.status == fp.Status.OK
    np.testing.assert_allclose(plan.inputs, best.inputs, atol=1e-5)


@pytest.mark.parametrize("scaled", [False, True])
def test_the_full_space_form_finds_the_optimum_of_a_small_problem(scaled):
    """States, inputs and multipliers together end at IPOPT's plan, costs of the last state included."""
    plant = fp.Plant({"y": "m"}, {"u": "m/s"}, {}, lambda q, u, p: {"y": u.u - 0.5 * q.y - 0.2 * q.y**3}, order=1)
    cost = fp.Quadratic(states={"y": 1.0}, effort={"u": 1.0}, terminal={"y": 2.0})
    sine = fp.Trajectory(lambda t: {"y": 0.3 * ca.sin(t)})
    ocp, data = horizon_of(plant, sine, fp.Horizon(stages=3, step=0.5), cost)
    plan = fp.solve(ocp, fp.FullSpaceFixedPoint(iterations=3000, tolerance=1e-7, scaled=scaled), FIRST[:1], data)
    np.testing.assert_allclose(plan.inputs, fp.solve(ocp, fp.Ipopt(accuracy=1e-10), FIRST[:1], data).inputs, atol=1e-6)


def test_rate_of_the_reduced_form():
    """On a linear-quadratic problem errors shrink by the largest |1 - a eig(D V'')|."""
    ocp, data, first = linear_problem()
    inputs = ca.MX.sym("U", 1, ocp.stages)
    slope = reduced_gradient(ocp)(first, inputs, data, np.zeros((2, ocp.stages)))[1]
    hessian = ca.Function("h", [inputs], [ca.jacobian(ca.vec(slope), ca.vec(inputs))])(np.zeros((1, 10))).full()
    values = float(1 / (ocp.step * ocp.curvature[0])) * np.linalg.eigvalsh(hessian)
    gain = 2 / (values.min() + values.max())
    predicted = np.abs(1 - gain * values).max()
    optimiser = fp.GradientFixedPoint(iterations=1, tolerance=1e-12, map=fp.Affine(gain=-2 * gain))
    best = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-11), first, data).inputs
    distances = [np.linalg.norm(plan - best) for plan, _ in repeated(optimiser, ocp, data, first, 25)]
    assert (distances[-1] / distances[-11]) ** 0.1 == pytest.approx(predicted, abs=1e-3)
    replace(optimiser, map=fp.Affine(gain=-3.6 / values.max())).check(ocp)
    with pytest.raises(NotContractive):
        replace(optimiser, map=fp.Affine(gain=-4.0 / values.max())).check(ocp)


@pytest.mark.parametrize("kind", [fp.FullSpaceFixedPoint, fp.GradientFixedPoint])
def test_a_call_goes_on_where_the_one_before_ended(kind):
    """Two calls are one with twice the iterations, however small the states are."""
    (*_, two), (one,) = (repeated(kind(k, 1e-6), *pendulum_problem(), FIRST / 10, 40 // k) for k in (20, 40))
    np.testing.assert_array_equal(two[0], one[0])


def test_the_baseline_is_orders_of_magnitude_slower_and_scaling_helps():
    """After the same 2000 iterations: plain, scaled; the default needs seven."""
    ocp, data = pendulum_problem()
    kinds = [fp.FullSpaceFixedPoint(iterations=2000, tolerance=1e-6, scaled=scaled) for scaled in (False, True)]
    left = [fp.solve(ocp, one, FIRST, data, calls=1).stationarity or 0.0 for one in kinds]
    assert left[0] > left[1] > 1e-6
    assert fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-6), FIRST, data).iterations < 10


# Status OK is a promise about the plan that is sent: on an unstable plant a plan that is not solved says so
LEVITATION = fp.Plant.of_states(
    states={"g": "mm", "w": "mm/s", "i": "A"},
    inputs={"V": "V"},
    rates=lambda x, u, p: {
        "g": x.w,
        "w": 9810.0 - p.K * (x.i / x.g) ** 2 / p.m,
        "i": (u.V - p.R * x.i) / p.L + 0.3 * x.i * x.w / x.g,
    },
    outputs={"gap": fp.Output("mm", lambda x, p: x.g)},
    parameters={
        "K": fp.Parameter(1.8e5, 2.1e5, "N mm^2/A^2"),
        "m": fp.Parameter(0.30, 0.34, "kg"),
        "R": fp.Parameter(2.0, 2.6, "Ohm"),
        "L": fp.Parameter(0.05, 0.06, "H"),
    },
)
CURRENT = 8 * np.sqrt(9810 * 0.34 / 2.1e5)
LEVITATED = fp.Problem(
    plant=LEVITATION,
    reference=fp.Trajectory(lambda t: {"gap": 8 + ca.sin(6 * t)}),
    start={"g": 8.0, "w": 6.0, "i": float(CURRENT)},
    period=1e-3,
    duration=1.5,
    measure_from=0.5,
    limits=fp.Limits(inputs={"V": (-20.0, 20.0)}),
    horizon=fp.Horizon(stages=15, step=1e-2, discretisation=fp.RungeKutta4(substeps=3)),
    cost=fp.Quadratic(outputs={"gap": 1.0}, rate={"V": 1e-7}),
    input_before={"V": float(2.6 * CURRENT)},
)


def levitated(optimiser):
    """Errors of the gap and statuses of every cycle, with the exact model."""
    run = fp.simulate(LEVITATED, fp.ExactModel(fp.RecedingHorizon(optimiser)), seed=0)
    error = np.abs(np.asarray(run["true_error"])).reshape(run.cycles, -1)[:, 0]
    return error, np.ravel(run["status"])


def test_no_cycle_is_ok_after_the_ball_is_lost():
    """One iteration in ten cycles is too little here: the ball falls, and no plan of a ball that falls is OK."""
    error, status = levitated(fp.FixedPointSolver(iterations=1, tolerance=1e-3))
    assert error.max() > 100.0
    lost = int(np.argmax(error > 0.5))
    assert (status[:lost] == fp.Status.OK).mean() > 0.5
    assert (status[lost:] != fp.Status.OK).all()


@pytest.mark.parametrize(
    "optimiser", [fp.FixedPointSolver(), fp.FixedPointSolver(iterations=10, tolerance=1e-3)], ids=["default", "ten"]
)
def test_a_ball_that_is_held_is_held_by_plans_that_are_ok(optimiser):
    error, status = levitated(optimiser)
    assert error[500:].max() < 1e-3
    assert (status == fp.Status.OK).all()


ASKED = r"need a C compiler \(the system's, or pip install ziglang\): compilation is turned off"


@pytest.mark.parametrize(
    ("compiler", "error", "words"), [("none", NotInstalled, ASKED), ("false", CompileError, "failed")]
)
def test_limits_of_states_need_a_compiler(monkeypatch, compiler, error, words):
    """No plan is made of zeros: without a compiler, or where it fails, such plans are refused; others run without it."""
    monkeypatch.setenv("FPIRHC_CC", compiler)
    short = replace(LEVITATED, duration=3e-3, measure_from=0.0)
    limited = replace(short, limits=fp.Limits(inputs=short.limits.inputs, states={"g": (2.0, 20.0)}))
    controller = fp.RecedingHorizon(fp.FixedPointSolver(tolerance=1e-3))
    with pytest.raises(error, match=words):
        fp.simulate(limited, controller, seed=0, compiled=False)
    assert not fp.simulate(short, controller, seed=0).compiled


@pytest.mark.parametrize(
    ("name", "iterations"), [("two_mass", None), ("cart_pole", None), ("two_link_arm", None), ("cart_pole", 5)]
)
def test_plans_with_the_exact_model_begin_with_the_parameters_of_their_run(name, iterations):
    """The first plan too: to the tolerance of plans that are solved, to the bit with five iterations, statuses equal."""
    task = fp.load_problem(name)
    problem = replace(task.problem, duration=50 * task.problem.period, measure_from=0.0)
    controller = fp.ExactModel(replace(task.controllers["RHC"], optimiser=fp.FixedPointSolver(iterations)))
    built, random = fp.simulator(problem, controller, compiled=False), np.random.default_rng(0)
    exact, close = np.ravel(problem.plant.exact), 0 if iterations else 1e-4
    tolerance = close * np.ptp(problem.limits.input_bounds(problem.plant)) / 2
    for factor in random.uniform(0.8, 1.25, (2, exact.size)):
        variant = problem.with_exact(exact * factor)
        one, other = built.run(variant=variant, seed=0), fp.simulate(variant, controller, seed=0, compiled=False)
        np.testing.assert_allclose(one["command"][0], other["command"][0], rtol=0, atol=1e-6 * tolerance)
        np.testing.assert_allclose(one["command"], other["command"], rtol=0, atol=tolerance)
        np.testing.assert_array_equal(one["status"], other["status"])


# Refusals, and who can
DOWN = fp.CustomCost(terms=lambda v: {"down": -(v.state.angle**2), "effort": v.input.torque**2})
FULL, PUSHED, SWUNG = fp.FullSpaceFixedPoint(1, 1e-6), {"torque": (-1.0, 1.0)}, {"angle": (-1.0, 1.0)}


@pytest.mark.parametrize(
    ("optimiser", "changes", "error", "words"),
    [
        (FIXED, {"state": np.zeros(3)}, InvalidValue, r"state has the shape \(3,\), expected \(2,\)"),
        (FIXED, {"data": np.zeros((2, 2))}, InvalidValue, r"data has the shape \(2, 2\), expected"),
        (FIXED, {"start": np.zeros((3, 3))}, InvalidValue, r"start has the shape \(3, 3\), expected \(1, 12\)"),
        (FIXED, {"state": np.full(2, np.nan)}, InvalidValue, "state is not finite"),
        (
            FIXED,
            {"cost": DOWN},
            fp.FpirhcError,
            r"bends upwards.*Use ReducedGradient",
        ),  # it has no model with a minimum
        (FULL, {"limits": fp.Limits(inputs=PUSHED)}, NotSupported, "for limits use FixedPointSolver"),
        (fp.GradientFixedPoint(1, 1e-6), {"limits": fp.Limits(states=SWUNG)}, NotSupported, "FixedPointSolver"),
        (replace(FULL, map=fp.Affine(gain=-1.0)), {}, NotContractive, "outside"),
    ],
)
def test_what_an_optimiser_does_not_serve_is_refused(optimiser, changes, error, words):
    ocp, data = pendulum_problem(changes.pop("cost", COST), changes.pop("limits", None))
    with pytest.raises(error, match=words):
        fp.solve(ocp, optimiser, **{"state": FIRST, "data": data} | changes)
