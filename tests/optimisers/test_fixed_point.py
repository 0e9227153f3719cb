"""Fixed-point iteration in place of the reduced gradient: its laws, certificates, plans at rest, against independent solvers."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from math import sin, sqrt
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import SWING, horizon_of, linear_problem, pendulum_problem, repeated, rolled
from helpers.kinds import slow_but
from helpers.machine import needs_compiler
from hypothesis import given, settings
from hypothesis import strategies as st

import fpirhc as fp
from fpirhc.conformance import compiled, posed
from fpirhc.contracts import judge


def call(optimiser, ocp, data, first, memory=None, bounds=None):
    """Plan, five numbers and memory, from rest or from a memory."""
    start = optimiser.memory(ocp).start() if memory is None else memory
    low, high = bounds or (ocp.input_lower, ocp.input_upper)
    plan, numbers, after = (v.full() for v in optimiser.step(ocp)(first, data, low, high, start))
    return plan, numbers[:, 0], after


@cache
def swung() -> Any:
    (ocp, data), optimiser = pendulum_problem(), fp.FixedPointSolver(iterations=25, tolerance=1e-8)
    return ocp, data, optimiser.step(ocp), optimiser.memory(ocp).start(), judge(ocp)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(seed=st.integers(0, 10**6), low=st.floats(-3, 0), high=st.floats(0, 3))
def test_random_box_constrained_problems_are_solved_or_honestly_not(seed, low, high):
    """Whatever is told is what an independent judge finds; the box is kept; and most are solved."""
    ocp, data, step, rest, judged = swung()
    bounds = np.array([low]), np.array([high])
    first = np.random.default_rng(seed).normal(size=2) * 2
    inputs, diagnostics, _ = (v.full() for v in step(first, data, *bounds, rest))
    cost, residual, _ = (float(v) for v in judged(inputs, first, data, *bounds, np.zeros((2, ocp.stages))))
    assert diagnostics.ravel()[0] == pytest.approx(cost, rel=1e-10)
    assert diagnostics.ravel()[1] == pytest.approx(residual, rel=1e-6, abs=1e-11)
    assert (diagnostics.ravel()[4] == fp.Status.OK) == (diagnostics.ravel()[1] <= 1e-8)
    assert diagnostics.ravel()[4] == fp.Status.OK
    assert low <= inputs.min() <= inputs.max() <= high


def moved(response, horizon, cost, limits=None, at=0.0):
    """Horizon and data of y' = response(y, u), which is to stand still."""
    gain, still = {"b": fp.Parameter(1.0, 1.0, "1")}, fp.Trajectory(lambda t: {"y": at + 0 * t})
    plant = fp.Plant({"y": "m"}, {"u": "m/s"}, gain, lambda q, u, p: {"y": response(q.y, p.b * u.u)}, order=1)
    return horizon_of(plant, still, horizon, cost, limits)


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
    inputs, _, _ = call(optimiser, ocp, data, first)
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
    cost, limits = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.1}), fp.Limits(inputs={"u": (-1.0, 1.0)})

    def growing(stages):
        return moved(lambda y, u: y**3 + u, fp.Horizon(stages, 0.1), cost, limits)

    ocp, data = growing(40)
    optimiser = fp.FixedPointSolver(iterations=6, tolerance=1e-6)
    plan = fp.solve(ocp, optimiser, np.array([30.0]), data, calls=3)
    assert (plan.cost, plan.stationarity, plan.feasibility) == (None, None, None)  # 0 would be the least cost of all
    said, _, stage = plan.overflow().rpartition(" at stage ")
    assert said.startswith("'y' is ")
    short, few = growing(int(stage))
    assert fp.solve(short, optimiser, np.array([30.0]), few, calls=3).overflow() == plan.overflow()  # at the end too
    inputs, diagnostics, memory = call(optimiser, ocp, data, np.array([30.0]))
    assert int(diagnostics[4]) == fp.Status.NON_FINITE
    assert np.isfinite(inputs).all()
    for _ in range(4):
        _, diagnostics, memory = call(optimiser, ocp, data, np.array([0.3]), memory)
    assert int(diagnostics[4]) == fp.Status.OK
    *_, (_, numbers) = repeated(fp.ReducedGradient(60, 1e-4), ocp, data, [0.3], 4, np.ones(40))  # of which it overflows
    assert numbers[4] == fp.Status.OK


def test_a_plan_is_begun_anew_where_no_input_leaves_the_model():
    """Y' = u - 2 sqrt(y) from 0.2 m: without inflow the plan is empty in 0.45 s, and no number comes back from there."""
    cost, limits = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.01}), fp.Limits(inputs={"u": (0.0, 3.0)})
    ocp, data = moved(lambda y, u: u - 2 * ca.sqrt(y), fp.Horizon(20, 0.05), cost, limits, at=0.3)
    optimiser = fp.FixedPointSolver(iterations=20, tolerance=1e-6)
    statuses = [int(numbers[4]) for _, numbers in repeated(optimiser, ocp, data, [0.2], 3)]
    assert (statuses[0], statuses[-1]) == (fp.Status.NON_FINITE, fp.Status.OK)


def test_feedback_keeps_unstable_plants_together():
    """An unstable plant over a long horizon, warm-started from a disturbed state: without the remembered feedback it overflows."""
    cost = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.1})
    ocp, data = moved(lambda y, u: 3 * y + 0.5 * y**3 + u, fp.Horizon(60, 0.1), cost)
    optimiser = fp.FixedPointSolver(iterations=3, tolerance=1e-6)
    _, _, memory = call(optimiser, ocp, data, np.zeros(1))
    _, diagnostics, _ = call(optimiser, ocp, data, np.array([0.1]), memory)
    assert diagnostics[1] < 1.0
    without = np.where(np.arange(memory.size) < ocp.stages, memory.ravel(), 0.0)
    _, diagnostics, _ = call(optimiser, ocp, data, np.array([0.1]), without)
    assert int(diagnostics[4]) != fp.Status.OK


def test_a_second_start_takes_the_iterations_of_both():
    """Those of a call with the remembered plan and of one without, and the plan that is cheaper."""
    one, box = fp.FixedPointSolver(iterations=4, tolerance=1e-8), ([-3.0], [3.0])
    memory, two = call(one, *swung()[:2], np.array([4.0, 4.0]), bounds=box)[2], replace(one, second_start=True)
    for state in ([2.0, 0.0], [0.5, 0.0]):  # the remembered plan is the cheaper one, and the other one is
        ways = (one, memory), (one, None), (two, memory)
        warm, cold, both = (call(o, *swung()[:2], np.array(state), m, box)[1] for o, m in ways)
        assert [*both[[0, 3, 4]]] == [min(warm[0], cold[0]), warm[3] + cold[3], fp.Status.OK]


def test_a_multiplier_counts_at_its_own_bound_alone():
    """Positive at the upper one, negative at the lower one: elsewhere a plan is judged as without it; NaN is no small residual."""
    task = (lambda y, u: u), fp.Horizon(stages=4, step=0.1), fp.Quadratic({"y": 1.0}, {"u": 1.0})
    free, bound = (moved(*task, fp.Limits(states=one)) for one in ({}, {"y": (-0.3, 0.4)}))

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
    cost = fp.CustomCost(terms=lambda v: {"flat": (v.input.u - 1) ** 4, "beside": beside + 0 * v.state.y})
    ocp, data = moved(lambda y, u: u, fp.Horizon(1, 1.0), cost, fp.Limits(inputs={"u": (-3.0, 3.0)}))
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
    cost = fp.CustomCost(terms=lambda v: {"valleys": (v.input.u**2 - 1) ** 2 - 0.3 * side * v.input.u})
    states = {"y": (-0.5, 9.0) if side < 0 else (-9.0, 0.5)}
    limits = fp.Limits(inputs={"u": (-3.0, 3.0)}, states=states, prices={"y": price})
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-6, hessian=fp.ExactHessian(), second_start=True)
    ocp, data = moved(lambda y, u: u, fp.Horizon(1, 1.0), cost, limits)
    memory, layout = optimiser.memory(ocp).start(), optimiser.memory(ocp)
    memory[layout.slice("plan_inputs")], memory[layout.slice("plan_barrier")] = -1.2 * side, 1e-4
    one = ocp, data, np.zeros(1)
    warm, cold = (call(replace(optimiser, second_start=False), *one, m) for m in (memory, None))
    dear = cold[1][0] + price * (side * cold[0] - 0.5) > warm[1][0] > cold[1][0]
    assert dear == (price > 1)
    assert call(optimiser, *one, memory)[0] == (warm if dear else cold)[0]


# Certificates: the predicted contraction is the measured one, and no bound is ever below the true error
PROBLEMS = ("two_mass", "van_der_pol", "cart_pole", "two_link_arm", "chain_of_masses")


@pytest.mark.parametrize("name", slow_but(PROBLEMS, "two_mass", "cart_pole"))
def test_no_bound_is_below_the_true_error(name):
    """On early and late iterates of every shipped problem: distance to the optimum, error of any input, and suboptimality."""
    ocp, first, data = posed(fp.load_problem(name).problem)
    optimiser, counted = fp.FixedPointSolver(iterations=1, tolerance=1e-13), 0
    best = fp.solve(ocp, replace(optimiser, tolerance=1e-9), first, data)
    for k, (inputs, numbers) in enumerate(repeated(optimiser, ocp, data, first, 14)):
        if k not in {0, 1, 2, 3, 5, 8, 13}:
            continue
        states = rolled(ocp, first, inputs, data).states
        plan = replace(best, inputs=inputs, states=states, cost=float(numbers[0]))
        certificate = fp.certify(plan)
        if not np.isfinite(certificate.input_error):
            continue
        counted += 1
        slack = 1e-7 * (1 + np.abs(best.inputs).max())
        assert np.abs(plan.inputs - best.inputs).max() <= certificate.input_error + slack
        assert plan.cost - best.cost <= certificate.suboptimality + 1e-11 * (1 + abs(best.cost))
    assert counted >= 2


def test_linear_quadratic_problems_need_one_step_and_have_the_factor_zero():
    """The Riccati sweep is exact there: from any plan the next one is the optimum, and the bound says so."""
    ocp, data, first = linear_problem()
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-6)
    [(_, numbers)] = repeated(optimiser, ocp, data, first, 1)
    assert numbers[1] < 1e-10
    certificate = fp.certify(fp.solve(ocp, optimiser, first, data))
    assert certificate.factor < 1e-8
    assert certificate.curvature == pytest.approx(1.0)


def test_factor_is_the_rate_of_the_iteration():
    """Errors in the M-norm shrink by K near the optimum."""
    ocp, data = pendulum_problem(SWING, horizon=fp.Horizon(stages=15, step=0.1))
    first = np.array([2.5, 0.0])
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-12)
    best = fp.solve(ocp, optimiser, first, data)
    plans = repeated(optimiser, ocp, data, first, 7, best.inputs + 1e-3)
    distances = [np.linalg.norm(inputs - best.inputs) for inputs, _ in plans]
    assert distances[-1] / distances[-2] == pytest.approx(fp.certify(best).factor, abs=0.01)


def test_bounds_hold_with_active_limits_of_states():
    """On plans near the optimum on a limit of the speed: no bound is below the true error; the limits are counted and priced."""
    limits = fp.Limits(inputs={"torque": (-8.0, 8.0)}, states={"angle'": (-0.3, 0.6)})
    ocp, data = pendulum_problem(limits=limits)
    first = np.array([0.6, 0.0])
    best = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-9), first, data)
    exact = fp.certify(best)
    assert exact.active == np.count_nonzero(best.state_multipliers) > 3
    assert exact.free == best.inputs.size - exact.active
    assert exact.factor < 1
    assert exact.input_error < 1e-6
    assert exact.complementarity < 1e-6
    rough = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-3), first, data)
    for plan in (rough, fp.solve(ocp, fp.Ipopt(accuracy=1e-5), first, data)):
        certificate = fp.certify(plan)
        assert np.abs(plan.inputs - best.inputs).max() <= certificate.input_error + 1e-8


# At rest on the reference the first plan is the feedforward: the optimum of cost zero, wherever the set-point is
MANY = 12  # set-points of every plant


@dataclass(frozen=True)
class Rest:
    """A plant of this order with one coordinate and a gain p.c, where it may rest, and the input that holds it there."""

    order: int
    response: Callable[..., Any]
    gain: float
    limits: tuple[float, float]
    places: tuple[float, float]
    needs: Callable[[float], float]


PLANTS = {
    # Squares of the input: a plan of zeros is at a place where no input does anything.
    "ball under a magnet": Rest(2, lambda q, v, u, p: 9.81 - p.c * (u.u / q.x) ** 2,
                                1.7e-3, (0.0, 3.0), (6e-3, 20e-3), lambda x: x * sqrt(9.81 / 1.7e-3)),
    "heater": Rest(1, lambda q, u, p: p.c * u.u**2 - 0.3 * q.x,
                   0.1, (0.0, 20.0), (1.0, 60.0), lambda x: sqrt(0.3 * x / 0.1)),
    "fan under a ball": Rest(2, lambda q, v, u, p: p.c * u.u**2 / (1 + q.x) - 9.81 - 0.2 * v.x,
                             0.02, (0.0, 60.0), (0.1, 1.5), lambda x: sqrt(9.81 * (1 + x) / 0.02)),
    "tank": Rest(1, lambda q, u, p: p.c * u.u - 0.4 * ca.sqrt(q.x),
                 0.7, (0.0, 5.0), (0.05, 4.0), lambda x: 0.4 * sqrt(x) / 0.7),
    "pendulum": Rest(2, lambda q, v, u, p: p.c * u.u - 9.81 * ca.sin(q.x) - 0.1 * v.x,
                     2.0, (-30.0, 30.0), (-3.1, 3.1), lambda x: 4.905 * sin(x)),
}  # fmt: skip
OPTIMISERS = {"default": fp.FixedPointSolver(), "one iteration": fp.FixedPointSolver(iterations=1, tolerance=1e-2)}


def problem_of(name: str, at: float) -> fp.Problem:
    one = PLANTS[name]
    gain, size = {"c": fp.Parameter(one.gain, 0.9 * one.gain, "1")}, one.places[1] - one.places[0]
    return fp.Problem(
        plant=fp.Plant({"x": "m"}, {"u": "A"}, gain, lambda *given: {"x": one.response(*given)}, order=one.order),
        reference=fp.Trajectory(lambda t: {"x": at + 0 * t}),
        start={"x": at},
        period=1e-3,
        duration=0.1,
        limits=fp.Limits(inputs={"u": one.limits}),
        horizon=fp.Horizon(stages=20, step=5e-3),
        cost=fp.Quadratic(states={"x": 100 / size**2}, deviation={"u": 1 / (one.limits[1] - one.limits[0]) ** 2}),
    )


@pytest.mark.parametrize("optimiser", OPTIMISERS.values(), ids=OPTIMISERS)
@pytest.mark.parametrize("name", PLANTS)
def test_the_first_command_of_a_plan_at_rest_is_the_feedforward(name, optimiser):
    """At a dozen set-points, to 1e-6 of the range, with status OK."""
    one = PLANTS[name]
    problem = problem_of(name, sum(one.places) / 2)
    ocp, _, table = posed(problem)
    places, needs = ocp.data.slice("reference"), ocp.data.slice("feedforward")
    wrong = []
    for at in np.random.default_rng(1).uniform(*one.places, MANY):
        data, needed = table.copy(), one.needs(at)
        data[places.start], data[needs] = at, needed
        state = np.array([at, 0.0])[: one.order]
        plan = fp.solve(ocp, optimiser, state, data)
        off = abs(plan.inputs[0, 0] - needed) / (one.limits[1] - one.limits[0])
        if off > 1e-6 or plan.status != fp.Status.OK:
            wrong.append((at, off, plan.status))
    assert wrong == []


@pytest.mark.parametrize("gap", [8e-3, 9e-3 - 1e-9, 9e-3, 9e-3 + 1e-9, 9.00001e-3, 12e-3, 14.75e-3])
@pytest.mark.parametrize("iterations", [None, 1])
def test_a_loop_begins_with_the_feedforward(gap, iterations):
    """By the controller itself, whatever its iterations: a ball held at 9 mm fell with one, and at 9.00001 mm it did not."""
    optimiser = fp.FixedPointSolver(iterations=iterations, tolerance=None if iterations is None else 1e-2)
    problem = problem_of("ball under a magnet", gap)
    stepper = fp.Stepper(problem, fp.RecedingHorizon(optimiser), compiled=False)
    command, _ = stepper.step(0.0, problem.start_state, np.zeros(1), stepper.start())
    assert command[0] == pytest.approx(PLANTS["ball under a magnet"].needs(gap), abs=3e-6)
