"""Fixed-point iteration in place of the reduced gradient: its laws, against independent solvers and dense algebra."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import SWING, horizon_of, linear_problem, pendulum_problem, repeated
from helpers.machine import needs_compiler
from hypothesis import given, settings
from hypothesis import strategies as st

import fpirhc as fp
from fpirhc.conformance import compiled
from fpirhc.contracts import judge


def call(optimiser, ocp, data, first, low, high, memory=None):
    start = optimiser.memory(ocp).start() if memory is None else memory
    return [v.full() for v in optimiser.step(ocp)(first, data, low, high, start)]


@settings(deadline=None, derandomize=True, max_examples=200)
@given(seed=st.integers(0, 10**6), low=st.floats(-3, 0), high=st.floats(0, 3))
def test_random_box_constrained_problems_are_solved_or_honestly_not(seed, low, high):
    """Whatever is told is what an independent judge finds; the box is kept; and most are solved."""
    ocp, data = CACHE["ocp"]
    bounds = np.array([low]), np.array([high])
    first = np.random.default_rng(seed).normal(size=2) * 2
    inputs, diagnostics, _ = (v.full() for v in CACHE["step"](first, data, *bounds, CACHE["memory"]))
    cost, residual, _ = (float(v) for v in CACHE["judge"](inputs, first, data, *bounds, np.zeros((2, ocp.stages))))
    assert diagnostics.ravel()[0] == pytest.approx(cost, rel=1e-10)
    assert diagnostics.ravel()[1] == pytest.approx(residual, rel=1e-6, abs=1e-11)
    assert (diagnostics.ravel()[4] == fp.Status.OK) == (diagnostics.ravel()[1] <= 1e-8)
    assert diagnostics.ravel()[4] == fp.Status.OK
    assert low <= inputs.min() <= inputs.max() <= high


CACHE: dict[str, Any] = {}
GAIN = {"b": fp.Parameter(1.0, 1.0, "1")}


def setup_module():
    ocp, data = pendulum_problem()
    optimiser = fp.FixedPointSolver(iterations=25, tolerance=1e-8)
    CACHE.update(ocp=(ocp, data), step=optimiser.step(ocp), memory=optimiser.memory(ocp).start(), judge=judge(ocp))


def test_linear_quadratic_problems_need_one_step():
    """The Riccati sweep is exact there: from any plan, the next one is the optimum."""
    ocp, data, first = linear_problem()
    _, diagnostics, _ = call(
        fp.FixedPointSolver(iterations=1, tolerance=1e-6), ocp, data, first, ocp.input_lower, ocp.input_upper
    )
    assert diagnostics.ravel()[1] < 1e-10


def test_gradient_newton_transition():
    """Large damping makes short safe steps: the same optimum, more iterations."""
    ocp, data, first = linear_problem()
    counts = []
    for damping in (0.0, 1.0, 10.0):
        plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-8, damping=damping), first, data, calls=500)
        assert plan.status == fp.Status.OK
        counts.append(plan.iterations)
    assert counts[0] < counts[1] < counts[2]


def test_a_saturating_map_limits_the_step():
    """With a small scale S the first move is at most S (atanh 1/2 + x*); the optimum is the same."""
    ocp, data, first = linear_problem()
    sigmoid = fp.Sigmoid(gain=-2.5, scale=0.2)
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-8, map=sigmoid)
    inputs, _, _ = call(optimiser, ocp, data, first, ocp.input_lower, ocp.input_upper)
    assert 0.1 < np.linalg.norm(inputs) <= sigmoid.largest_step() + 1e-12
    limited = fp.solve(ocp, optimiser, first, data, calls=300)
    free = fp.solve(ocp, replace(optimiser, map=fp.Affine(gain=-2.0)), first, data)
    assert limited.status == fp.Status.OK
    assert limited.iterations > free.iterations
    np.testing.assert_allclose(limited.inputs, free.inputs, atol=1e-6)


def test_exact_hessian_converges_quadratically():
    """Near the optimum Gauss-Newton shrinks the error by a constant; the exact Hessian squares it."""
    ocp, data = pendulum_problem(SWING, horizon=fp.Horizon(stages=15, step=0.1))
    first = np.array([2.5, 0.0])
    near = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=0.1), first, data).inputs
    iterations = {}
    for model in (None, fp.ExactHessian()):
        plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-10, hessian=model), first, data, start=near)
        assert plan.status == fp.Status.OK
        iterations[model is None] = plan.iterations
    assert iterations[False] <= 5 < 2 * 5 <= iterations[True]


def test_single_iterations_get_out_of_a_bad_plan():
    """A plan whose full, short and plain steps are all too long, one iteration per call: what is learned lasts over calls."""
    mass = {"mass": fp.Parameter(0.2, 0.2, "kg")}
    plant = fp.Plant(
        {"height": "m"},
        {"thrust": "N"},
        mass,
        lambda q, v, u, p: {"height": (u.thrust - 0.3 * v.height * ca.fabs(v.height)) / p.mass - 9.81},
    )
    reference = fp.Trajectory(lambda t: {"height": 2 + 1.5 * ca.sin(1.2 * t)})
    cost = fp.Quadratic(states={"height": 1e3, "height'": 1.0}, deviation={"thrust": 1e-2})
    horizon, limits = fp.Horizon(stages=20, step=2e-2), fp.Limits(inputs={"thrust": (0.0, 40.0)})
    ocp, data = horizon_of(plant, reference, horizon, cost, limits)
    one, first = fp.FixedPointSolver(iterations=1, tolerance=1e-6), np.array([2.0, 0.0])
    best = fp.solve(ocp, fp.Ipopt(), first, data)
    # As after a plan for another model: nearly all thrust at once.
    *_, (inputs, numbers) = repeated(one, ocp, data, first, 40, np.linspace(40.0, 0.0, horizon.stages))
    assert numbers[4] == fp.Status.OK
    np.testing.assert_allclose(inputs, best.inputs, atol=1e-4)


def test_overflowing_models_are_told_and_survived():
    """A model that overflows in every plan: NON_FINITE with a finite plan; then a good first state is solved."""
    plant = fp.Plant({"y": "m"}, {"u": "N"}, GAIN, lambda q, u, p: {"y": q.y**3 + u.u * p.b}, order=1)
    reference = fp.Trajectory(lambda t: {"y": 0 * t})
    cost, horizon = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.1}), fp.Horizon(stages=40, step=0.1)
    ocp, data = horizon_of(plant, reference, horizon, cost, fp.Limits(inputs={"u": (-1.0, 1.0)}))
    optimiser = fp.FixedPointSolver(iterations=6, tolerance=1e-6)
    plan = fp.solve(ocp, optimiser, np.array([30.0]), data, calls=3)
    assert (plan.cost, plan.stationarity, plan.feasibility) == (None, None, None)  # 0 would be the least cost of all
    said, _, stage = plan.overflow().rpartition(" at stage ")
    assert said.startswith("'y' is ")
    short, few = horizon_of(plant, reference, fp.Horizon(int(stage), 0.1), cost, fp.Limits(inputs={"u": (-1.0, 1.0)}))
    assert fp.solve(short, optimiser, np.array([30.0]), few, calls=3).overflow() == plan.overflow()  # at the end too
    inputs, diagnostics, memory = call(optimiser, ocp, data, np.array([30.0]), ocp.input_lower, ocp.input_upper)
    assert int(diagnostics.ravel()[4]) == fp.Status.NON_FINITE
    assert np.isfinite(inputs).all()
    for _ in range(4):
        _, diagnostics, memory = call(optimiser, ocp, data, np.array([0.3]), ocp.input_lower, ocp.input_upper, memory)
    assert int(diagnostics.ravel()[4]) == fp.Status.OK
    *_, (_, numbers) = repeated(fp.ReducedGradient(60, 1e-4), ocp, data, [0.3], 4, np.ones(40))  # of which it overflows
    assert numbers[4] == fp.Status.OK


def test_a_plan_is_begun_anew_where_no_input_leaves_the_model():
    """Y' = u - 2 sqrt(y) from 0.2 m: without inflow the plan is empty in 0.45 s, and no number comes back from there."""
    plant = fp.Plant({"y": "m"}, {"u": "m/s"}, GAIN, lambda q, u, p: {"y": p.b * u.u - 2 * ca.sqrt(q.y)}, order=1)
    reference = fp.Trajectory(lambda t: {"y": 0.3 + 0 * t})
    cost, horizon = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.01}), fp.Horizon(stages=20, step=0.05)
    ocp, data = horizon_of(plant, reference, horizon, cost, fp.Limits(inputs={"u": (0.0, 3.0)}))
    optimiser = fp.FixedPointSolver(iterations=20, tolerance=1e-6)
    step = optimiser.step(ocp)
    memory, statuses = np.zeros(optimiser.memory(ocp).size), []
    for _ in range(3):
        _, diagnostics, memory = step(np.array([0.2]), data, ocp.input_lower, ocp.input_upper, memory)
        statuses.append(fp.Status(int(diagnostics.full().ravel()[4])))
    assert statuses[0] == fp.Status.NON_FINITE
    assert statuses[-1] == fp.Status.OK


def test_feedback_keeps_unstable_plants_together():
    """An unstable plant over a long horizon, warm-started from a disturbed state: without the remembered feedback it overflows."""
    plant = fp.Plant({"y": "m"}, {"u": "N"}, GAIN, lambda q, u, p: {"y": 3 * q.y + 0.5 * q.y**3 + u.u * p.b}, order=1)
    reference = fp.Trajectory(lambda t: {"y": 0 * t})
    cost, horizon = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.1}), fp.Horizon(stages=60, step=0.1)
    ocp, data = horizon_of(plant, reference, horizon, cost, fp.Limits())
    optimiser = fp.FixedPointSolver(iterations=3, tolerance=1e-6)
    _, _, memory = call(optimiser, ocp, data, np.zeros(1), ocp.input_lower, ocp.input_upper)
    _, diagnostics, _ = call(optimiser, ocp, data, np.array([0.1]), ocp.input_lower, ocp.input_upper, memory)
    assert diagnostics.ravel()[1] < 1.0
    without = np.where(np.arange(memory.size) < ocp.stages, memory.ravel(), 0.0)
    _, diagnostics, _ = call(optimiser, ocp, data, np.array([0.1]), ocp.input_lower, ocp.input_upper, without)
    assert int(diagnostics.ravel()[4]) != fp.Status.OK


def test_a_second_start_takes_the_iterations_of_both():
    """Those of a call with the remembered plan and of one without, and the plan that is cheaper."""
    one, box = fp.FixedPointSolver(iterations=4, tolerance=1e-8), ([-3.0], [3.0])
    memory, two = call(one, *CACHE["ocp"], np.array([4.0, 4.0]), *box)[2], replace(one, second_start=True)
    for state in ([2.0, 0.0], [0.5, 0.0]):  # the remembered plan is the cheaper one, and the other one is
        ways = (one, memory), (one, None), (two, memory)
        warm, cold, both = (call(o, *CACHE["ocp"], np.array(state), *box, m)[1].ravel() for o, m in ways)
        assert [*both[[0, 3, 4]]] == [min(warm[0], cold[0]), warm[3] + cold[3], fp.Status.OK]


def test_a_multiplier_counts_at_its_own_bound_alone():
    """Positive at the upper one, negative at the lower one: elsewhere a plan is judged as without it; NaN is no small residual."""
    plant = fp.Plant({"y": "m"}, {"u": "m/s"}, GAIN, lambda q, u, p: {"y": p.b * u.u}, order=1)
    task = fp.Trajectory(lambda t: {"y": 0 * t}), fp.Horizon(stages=4, step=0.1), fp.Quadratic({"y": 1.0}, {"u": 1.0})
    free, bound = (horizon_of(plant, *task, fp.Limits(states=one)) for one in ({}, {"y": (-0.3, 0.4)}))

    def residual(of, at, size):
        return float(judge(of[0])(np.zeros((1, 4)), [at], of[1], [-9.0], [9.0], np.full((1, 4), size))[1])

    pairs = {(at, size) for at in (-0.3, 0.1, 0.4) for size in (-2.0, 0.0, 2.0)}
    counts = {pair for pair in pairs if residual(bound, *pair) != pytest.approx(residual(free, pair[0], 0.0))}
    assert counts == {(-0.3, -2.0), (0.4, 2.0)}
    assert residual(bound, 0.1, np.nan) > 1


@needs_compiler
@pytest.mark.parametrize(("beside", "status"), [(0.0, fp.Status.NOT_CONVERGED), (100.0, fp.Status.OK)])
def test_a_move_that_lowers_the_cost_by_nothing_is_no_error(beside, status):
    """A sweep at 1.01 of (u - 1)^4 wants a third of the way, which lowers it by 7e-9: all of it, or 1e-10 of a cost beside it."""
    gain = {"b": fp.Parameter(1.0, 1.0, "1")}
    plant = fp.Plant({"y": "m"}, {"u": "m/s"}, gain, lambda q, u, p: {"y": p.b * u.u - 0.0 * q.y}, order=1)
    cost = fp.CustomCost(terms=lambda v: {"flat": (v.input.u - 1) ** 4, "beside": beside + 0 * v.state.y})
    reference, limits = fp.Trajectory(lambda t: {"y": 0 * t}), fp.Limits(inputs={"u": (-3.0, 3.0)})
    ocp, data = horizon_of(plant, reference, fp.Horizon(stages=1, step=1.0), cost, limits)
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-4)
    memory = optimiser.memory(ocp).start()
    memory[optimiser.memory(ocp).slice("plan_inputs")] = 1.01
    for step in (optimiser.step(ocp), compiled(optimiser.step(ocp))):
        assert int(step(np.zeros(1), data, [-3.0], [3.0], memory)[1][4]) == status


@needs_compiler
@pytest.mark.parametrize("price", [0.1, 1.5])
@pytest.mark.parametrize("side", [-1, 1])
def test_of_two_starts_the_plan_that_costs_less_with_its_violations_is_taken(side, price):
    """A remembered plan stays in its valley; the one from nothing is in a deeper one, beyond a limit with a price."""
    plant = fp.Plant({"y": "m"}, {"u": "m/s"}, GAIN, lambda q, u, p: {"y": p.b * u.u}, order=1)
    cost = fp.CustomCost(terms=lambda v: {"valleys": (v.input.u**2 - 1) ** 2 - 0.3 * side * v.input.u})
    states = {"y": (-0.5, 9.0) if side < 0 else (-9.0, 0.5)}
    limits = fp.Limits(inputs={"u": (-3.0, 3.0)}, states=states, prices={"y": price})
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-6, hessian=fp.ExactHessian(), second_start=True)
    reference, horizon = fp.Trajectory(lambda t: {"y": 0 * t}), fp.Horizon(stages=1, step=1.0)
    ocp, data = horizon_of(plant, reference, horizon, cost, limits)
    memory, layout = optimiser.memory(ocp).start(), optimiser.memory(ocp)
    memory[layout.slice("plan_inputs")], memory[layout.slice("plan_barrier")] = -1.2 * side, 1e-4
    one = ocp, data, np.zeros(1), [-3.0], [3.0]
    warm, cold = (call(replace(optimiser, second_start=False), *one, m) for m in (memory, None))
    dear = cold[1][0] + price * (side * cold[0] - 0.5) > warm[1][0] > cold[1][0]
    assert dear == (price > 1)
    assert call(optimiser, *one, memory)[0] == (warm if dear else cold)[0]
