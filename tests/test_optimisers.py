"""Optimisers: every plan is stationary or says that it is not; all find the same optimum."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import chain, pendulum

import fpirhc as fp
from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.horizon.problem import stage_data, transcribe
from fpirhc.optimisers.nlp import quadratic_solver

TASK = fp.load_problem("two_mass")
GRADIENT = fp.ReducedGradient(iterations=60, tolerance=1e-4)
BACKENDS = (fp.InteriorPoint(), fp.Fatrop(), fp.SequentialQuadratic(), fp.SequentialQuadratic(quadratic=fp.Osqp()))
EVERY = (GRADIENT, *BACKENDS)
BOXES = {
    "free": fp.Limits(),
    "active": fp.Limits(inputs={"Q1": (-5.0, 10.0), "Q2": (-30.0, 30.0)}),
    "all active": fp.Limits(inputs={"Q1": (-5.0, 10.0), "Q2": (-30.0, -15.0)}),
}
ids = [type(o).__name__ + ("" if "quadratic" not in dir(o) else o.quadratic.plugin) for o in EVERY]


def two_mass(limits):
    """(ocp, data, first state) of the shipped problem's first horizon."""
    p = TASK.problem
    ocp = transcribe(p.plant, p.reference, p.horizon, p.cost, limits)
    return ocp, stage_data(p.plant, p.reference, p.horizon, p.cost)(0.0, p.plant.approximate), p.start_state


@pytest.mark.parametrize("limits", BOXES.values(), ids=BOXES)
@pytest.mark.parametrize("optimiser", EVERY, ids=ids)
def test_all_find_the_same_stationary_plan(optimiser, limits):
    """Same cost to 1e-6, and the plan's own verification agrees with what the optimiser told."""
    ocp, data, first = two_mass(limits)
    plan = fp.solve(ocp, optimiser, first, data)
    best = fp.solve(ocp, fp.SequentialQuadratic(), first, data)
    assert plan.status == fp.Status.OK
    assert plan.cost == pytest.approx(best.cost, rel=1e-6)
    cost, stationarity, feasibility = plan.verify()
    assert (cost, stationarity, feasibility) == pytest.approx((plan.cost, plan.stationarity, 0.0), rel=1e-9, abs=1e-12)
    assert stationarity <= 1e-3
    assert np.all(plan.inputs.min(axis=1) >= ocp.input_lower)
    assert np.all(plan.inputs.max(axis=1) <= ocp.input_upper)


@pytest.mark.parametrize("optimiser", BACKENDS[:3], ids=ids[1:4])
def test_state_limits_are_kept(optimiser):
    """The optimum rides on the limit of q1; stationarity counts the limit's multipliers."""
    ocp, data, first = two_mass(fp.Limits(inputs={"Q1": (-50.0, 50.0)}, states={"q1": (2.195, 2.3)}))
    plan = fp.solve(ocp, optimiser, first, data)
    assert plan.status == fp.Status.OK
    assert plan.states[0].min() == pytest.approx(2.195, abs=1e-4) or plan.states[0].max() == pytest.approx(
        2.3, abs=1e-4
    )
    assert plan.feasibility < 1e-4


def test_state_limits_are_refused_by_the_reduced_gradient():
    """It says who can."""
    ocp, data, first = two_mass(fp.Limits(states={"q1": (2.0, 2.3)}))
    with pytest.raises(NotSupported, match="InteriorPoint"):
        fp.solve(ocp, GRADIENT, first, data)


def test_contradictory_limits_are_infeasible_not_solved():
    """A first state from which the limit cannot be kept: the status says so."""
    ocp, data, first = two_mass(fp.Limits(inputs={"Q1": (-1.0, 1.0)}, states={"q1": (3.0, 3.5)}))
    plan = fp.solve(ocp, fp.InteriorPoint(), first, data, calls=1)
    assert plan.status in (fp.Status.INFEASIBLE, fp.Status.NON_FINITE)
    assert np.isfinite(plan.inputs).all()


@settings(deadline=None, derandomize=True, max_examples=40)
@given(seed=st.integers(0, 10**6), low=st.floats(-3, 0), high=st.floats(0, 3), weight=st.floats(1e-3, 10))
def test_random_box_constrained_problems_are_solved_or_honestly_not(seed, low, high, weight):
    """Never a wrong 'converged': whenever the status is OK, the independent residual is below the tolerance."""
    random = np.random.default_rng(seed)
    ocp, data = _random_problem()
    ocp_bounds = (np.array([low]), np.array([high]))
    step = GRADIENT.step(ocp)
    memory = GRADIENT.memory(ocp).start()
    first = random.normal(size=2)
    inputs, diagnostics, _ = step(first, data, *ocp_bounds, memory)
    from fpirhc.optimisers.base import judge

    _, residual, _ = judge(ocp)(inputs, first, data, *ocp_bounds, np.zeros((2, ocp.stages)))
    told = diagnostics.full().ravel()
    assert told[1] == pytest.approx(float(residual), rel=1e-9, abs=1e-12)
    assert (told[4] == fp.Status.OK) == (told[1] <= GRADIENT.tolerance)
    assert low - 1e-12 <= inputs.full().min() <= inputs.full().max() <= high + 1e-12
    assert weight > 0


def _random_problem(cache={}):  # noqa: B006 -- built once for all examples
    if not cache:
        plant, reference = pendulum(), fp.Trajectory(lambda t: {"angle": ca.sin(t)})
        horizon = fp.Horizon(stages=10, step=0.05)
        cost = fp.Quadratic(states={"angle": 10.0, "angle'": 0.1}, effort={"torque": 0.05})
        cache["ocp"] = transcribe(plant, reference, horizon, cost, fp.Limits())
        cache["data"] = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate)
    return cache["ocp"], cache["data"]


@pytest.mark.parametrize("optimiser", EVERY, ids=ids)
def test_poisoned_problem_keeps_the_last_plan_and_recovers(optimiser):
    """NaN data: status NON_FINITE and the remembered plan, never NaN; the next good problem is solved."""
    ocp, data, first = two_mass(BOXES["active"])
    step, memory = optimiser.step(ocp), optimiser.memory(ocp).start()
    bounds = (ocp.input_lower, ocp.input_upper)
    good, _, memory = step(first, data, *bounds, memory)
    poisoned, told, memory = step(first * np.nan, data, *bounds, memory)
    assert int(told[4]) == fp.Status.NON_FINITE
    np.testing.assert_allclose(poisoned.full()[:, :-1], good.full()[:, 1:], atol=1e-12)
    assert np.isfinite(memory.full()).all()
    for _ in range(5):
        _, told, memory = step(first, data, *bounds, memory)
    assert int(told[4]) == fp.Status.OK


def test_memory_is_shifted_by_one_stage():
    """The next call starts where this one's second stage was."""
    ocp, data, first = two_mass(BOXES["free"])
    inputs, _, memory = GRADIENT.step(ocp)(first, data, ocp.input_lower, ocp.input_upper, GRADIENT.memory(ocp).start())
    kept = memory.full().ravel()[: 2 * ocp.stages].reshape(ocp.stages, 2).T
    np.testing.assert_array_equal(kept, np.hstack([inputs.full()[:, 1:], inputs.full()[:, -1:]]))


def test_settings_are_checked():
    """Numbers that cannot be meant are refused; traps among the solvers are refused by name with the reason."""
    with pytest.raises(InvalidValue, match="at least 1 iteration"):
        fp.ReducedGradient(iterations=0, tolerance=1e-3)
    with pytest.raises(InvalidValue, match="positive tolerance"):
        fp.InteriorPoint(tolerance=0.0)
    with pytest.raises(NotSupported, match="infeasible points marked as solved"):
        quadratic_solver("fatrop")
    with pytest.raises(InvalidValue, match="Did you mean 'osqp'"):
        quadratic_solver("osq")


def receding(optimiser, deformation=None, **settings):
    """A short closed loop of two_mass."""
    from dataclasses import replace

    problem = replace(TASK.problem, duration=0.3, measure_from=0.1)
    return problem, fp.RecedingHorizon(optimiser, deformation or fp.Identity(), **settings)


@pytest.mark.parametrize("optimiser", BACKENDS, ids=ids[1:])
def test_all_backends_drive_the_same_loop(optimiser):
    """RHC+FPI with any optimiser gives the same motion."""
    problem, controller = receding(optimiser, fp.Sigmoid(gain=-0.5, scale=20.0))
    run = fp.simulate(problem, controller, seed=0)
    _, gradient = receding(GRADIENT, fp.Sigmoid(gain=-0.5, scale=20.0))
    other = fp.simulate(problem, gradient, seed=0)
    assert run.stop is None
    assert run["status"].max() <= fp.Status.NOT_CONVERGED
    np.testing.assert_allclose(run["state"][:, :2], other["state"][:, :2], atol=1e-4)


@pytest.mark.parametrize(
    "nominal",
    [fp.Restart(), fp.RestartAndTrack(fp.Exponential(rate=6.0)), fp.OpenPlan(fp.Exponential(rate=6.0))],
    ids=lambda n: type(n).__name__,
)
def test_every_variant_is_cured_by_adaptation(nominal):
    """Restart, restart with tracking, and a propagated plan that is tracked: each follows the reference with FPI."""
    from dataclasses import replace

    problem = replace(TASK.problem, duration=4.0, measure_from=2.0)
    errors = {}
    for name, deformation in (("plain", fp.Identity()), ("adaptive", fp.Sigmoid(gain=-0.5, scale=20.0))):
        run = fp.simulate(problem, fp.RecedingHorizon(GRADIENT, deformation, nominal=nominal), seed=0)
        errors[name] = max(fp.measure(problem, run).rms_error.values())
    assert errors["adaptive"] < 0.1 * errors["plain"]
    assert errors["adaptive"] < 5e-3


def test_bounds_of_the_plan_are_shifted_by_the_correction():
    """The deformation takes part of the actuator, so the plan gets the rest: planned + correction stays inside."""
    from dataclasses import replace

    tight = replace(
        TASK.problem,
        limits=fp.Limits(inputs={"Q1": (-60.0, 10.0), "Q2": (-60.0, 40.0)}),
        duration=2.0,
        measure_from=0.5,
    )
    run = fp.simulate(tight, fp.RecedingHorizon(GRADIENT, fp.Sigmoid(gain=-0.5, scale=20.0)), seed=0)
    assert run["command.Q1"].max() <= 10.0
    fresh = np.arange(10, run.cycles, 10)
    meant = run["planned.Q1"][fresh] + run["correction.Q1"][fresh - 1]
    assert meant.max() <= 10.0 + 1e-6
    assert meant.max() > 9.9


POLICIES = {"HoldPlan": (fp.HoldPlan(), fp.Status.HELD), "Feedforward": (fp.Feedforward(), fp.Status.HELD)}


@pytest.mark.parametrize("policy", POLICIES)
def test_failed_solves_are_counted_and_follow_the_policy(policy):
    """An infeasible limit from the start: the policy acts, the run goes on, the status counts it."""
    chosen, status = POLICIES[policy]
    problem, controller = receding(fp.InteriorPoint(iterations=30), on_failure=chosen)
    from dataclasses import replace

    problem = replace(
        problem,
        limits=fp.Limits(inputs={"Q1": (-5.0, 5.0)}, states={"q1": (3.0, 4.0)}),
        duration=0.05,
        measure_from=0.0,
    )
    run = fp.simulate(problem, controller, seed=0)
    assert run.stop is None
    assert fp.measure(problem, run).statuses == {status.name: 50}


def test_stop_run_ends_with_the_reason():
    """StopRun makes the failed plan visible at once."""
    from dataclasses import replace

    problem, controller = receding(fp.InteriorPoint(iterations=30), on_failure=fp.StopRun())
    problem = replace(
        problem,
        limits=fp.Limits(inputs={"Q1": (-5.0, 5.0)}, states={"q1": (3.0, 4.0)}),
        duration=0.05,
        measure_from=0.0,
    )
    run = fp.simulate(problem, controller, seed=0)
    assert run.stop is not None
    assert "planned.Q1" in run.stop


def test_scale_is_chosen_from_the_input_limits():
    """S covers a jump of the command from limit to limit; without limits it must be given."""
    from dataclasses import replace

    controller = fp.RecedingHorizon(GRADIENT, fp.Sigmoid(gain=-0.5)).resolved(TASK.problem)
    jump = np.linalg.norm([600 / 1.5, 600 / 2.6])
    assert controller.deformation.largest_step() == pytest.approx(jump, rel=0.01)
    with pytest.raises(InvalidValue, match="input 'Q1' has no finite limits"):
        fp.RecedingHorizon(GRADIENT, fp.Sigmoid(gain=-0.5)).resolved(replace(TASK.problem, limits=fp.Limits()))


def test_chain_of_order_four_under_receding_horizon():
    """Any relative order works: a chain of four integrators with a wrong mass."""
    from dataclasses import replace

    plant = chain(4)
    wrong = replace(plant, parameters={"m": fp.Parameter(1.5, 1.0, "kg")})
    problem = fp.Problem(
        plant=wrong,
        reference=fp.Trajectory(lambda t: {"y": ca.sin(t)}),
        start={"y": 0.0, "y'": 1.0, "y'''": -1.0},
        period=1e-2,
        duration=6.0,
        limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
        horizon=fp.Horizon(stages=30, step=0.05),
        cost=fp.Quadratic(states={"y": 1e3, "y'": 1e2, "y''": 10.0, "y'''": 1.0}, correction={"u": 1e-2}),
        measure_from=3.0,
    )
    optimiser = fp.SequentialQuadratic()
    plain, adaptive = (
        fp.simulate(problem, fp.RecedingHorizon(optimiser, d), seed=0) for d in (fp.Identity(), fp.Sigmoid(gain=-0.8))
    )
    assert fp.measure(problem, adaptive).rms_error["y"] < 0.5 * fp.measure(problem, plain).rms_error["y"]
