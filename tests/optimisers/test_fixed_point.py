"""Fixed-point iteration in place of the reduced gradient: its laws, against independent solvers and dense algebra."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import pendulum
from hypothesis import given, settings
from hypothesis import strategies as st

import fpirhc as fp
from fpirhc import Search
from fpirhc.contracts import judge, reduced_gradient
from fpirhc.horizon.hessian_models import GaussNewton
from fpirhc.horizon.riccati import box_policy
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.plain import call_symbols, first_anchor
from fpirhc.symbolic.native import find_compiler, native
from fpirhc.symbolic.program import generate

PLANT, REFERENCE = pendulum(), fp.Trajectory(lambda t: {"angle": ca.sin(2 * t)})
HORIZON = fp.Horizon(stages=12, step=0.05)
COST = fp.Quadratic(states={"angle": 10.0, "angle'": 0.1}, effort={"torque": 0.05})
SWING = fp.Quadratic(states={"angle": 0.1}, effort={"torque": 1e-3}, terminal={"angle": 10.0, "angle'": 1.0})


def pendulum_problem(cost=COST, limits=None, horizon=HORIZON):
    ocp = transcribe(PLANT, REFERENCE, horizon, cost, limits or fp.Limits())
    return ocp, stage_data(PLANT, REFERENCE, horizon, cost)(0.0, PLANT.approximate).full()


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


def setup_module():
    ocp, data = pendulum_problem()
    optimiser = fp.FixedPoint(iterations=25, tolerance=1e-8)
    CACHE.update(ocp=(ocp, data), step=optimiser.step(ocp), memory=optimiser.memory(ocp).start(), judge=judge(ocp))


@pytest.mark.parametrize("cost", [COST, SWING], ids=["tracking", "swing-up"])
@pytest.mark.parametrize("high", [100.0, 3.0, 0.5])
def test_same_optimum_as_ipopt(cost, high):
    """Cost to 1e-6, inputs to 1e-5, bounds active or not."""
    limits = fp.Limits(inputs={"torque": (-high, high)})
    ocp, data = pendulum_problem(cost, limits)
    first = np.array([1.0, -1.0])
    plan = fp.solve(ocp, fp.FixedPoint(iterations=30, tolerance=1e-9), first, data)
    other = fp.solve(ocp, fp.Ipopt(tolerance=1e-5, accuracy=1e-11), first, data)
    assert plan.status == fp.Status.OK
    assert plan.cost == pytest.approx(other.cost, rel=1e-6)
    np.testing.assert_allclose(plan.inputs, other.inputs, atol=1e-5)


def test_a_horizon_knows_the_optimisers_that_are_gone():
    """A new optimiser may have the address of one that is gone; it is solved by its own iteration all the same."""
    ocp, data = pendulum_problem()
    for tolerance in (1.0, 1e-3, 1e-9, 1e-2, 1e-8):
        plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=tolerance), np.array([1.0, -1.0]), data)
        assert plan.stationarity is not None
        assert plan.stationarity <= tolerance


@pytest.mark.parametrize("optimiser", [fp.FixedPoint(iterations=6, tolerance=1e-6)], ids=["default"])
def test_linear_quadratic_problems_need_one_step(optimiser):
    """The Riccati sweep is exact there: from any plan, the next one is the optimum."""
    ocp, data, first = linear_problem()
    _, diagnostics, _ = call(replace(optimiser, iterations=1), ocp, data, first, ocp.input_lower, ocp.input_upper)
    assert diagnostics.ravel()[1] < 1e-10


def linear_problem():
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        order=2,
        response=lambda q, v, u, p: {"y": -q.y + u.u * p.gain},
        parameters={"gain": fp.Parameter(1.0, 1.0, "1")},
    )
    reference = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    cost = fp.Quadratic(states={"y": 3.0, "y'": 0.5}, effort={"u": 0.2})
    horizon = fp.Horizon(stages=10, step=0.1)
    ocp = transcribe(plant, reference, horizon, cost, fp.Limits())
    return ocp, stage_data(plant, reference, horizon, cost)(0.0, plant.approximate).full(), np.array([1.0, -2.0])


def test_clipping_a_newton_step_is_not_done():
    """Clipping gives (1, 0); the minimiser of the box QP is (1, 0.4), and the input at its bound gets no feedback."""
    matrix, centre = np.array([[1, 0.9], [0.9, 1]]), np.array([2.0, -0.5])
    slope = -matrix @ centre
    move, gain = box_policy(2, 1)(slope, matrix, np.ones((2, 1)), np.zeros(2), np.ones(2))
    np.testing.assert_allclose(move.full().ravel(), [1.0, 0.4], atol=1e-12)
    np.testing.assert_allclose(gain.full().ravel(), [0.0, -1.0], atol=1e-12)


@settings(deadline=None, derandomize=True, max_examples=100)
@given(seed=st.integers(0, 10**6), size=st.integers(1, 4))
def test_stage_box_programs_against_scipy(seed, size):
    """Never worse than standing still; nearly always the minimiser that an independent solver finds."""
    from scipy.optimize import lsq_linear

    random = np.random.default_rng(seed)
    root = random.normal(size=(size + 2, size))
    matrix, slope = root.T @ root + 0.1 * np.eye(size), random.normal(size=size) * 3
    low, high = -random.uniform(0, 2, size), random.uniform(0, 2, size)
    policy = POLICIES.setdefault(size, box_policy(size, 1))
    move = policy(slope, matrix, np.ones((size, 1)), low, high)[0].full().ravel()
    value = slope @ move + 0.5 * move @ matrix @ move
    factor = np.linalg.cholesky(matrix).T
    best = lsq_linear(factor, -np.linalg.solve(factor.T, slope), (low - 1e-12, high + 1e-12), tol=1e-14).x
    assert value <= 0
    assert np.all(move >= low)
    assert np.all(move <= high)
    MISSED.append(value > slope @ best + 0.5 * best @ matrix @ best + 1e-8)
    assert sum(MISSED) <= 0.03 * max(len(MISSED), 100)


POLICIES: dict[Any, ca.Function] = {}
MISSED: list[bool] = []


def test_measured_contraction_is_the_predicted_one():
    """Near the optimum errors shrink by the spectral radius of I - M^-1 V'', found by dense algebra."""
    ocp, data = pendulum_problem(SWING, horizon=fp.Horizon(stages=15, step=0.1))
    first = np.array([2.5, 0.0])
    optimiser = fp.FixedPoint(iterations=1, tolerance=1e-12)
    best = fp.solve(ocp, optimiser, first, data).inputs
    predicted, model = predicted_contraction(ocp, data, first, best)
    step, memory = optimiser.step(ocp), optimiser.memory(ocp).start()
    memory[optimiser.memory(ocp).slice("plan_inputs")] = best.ravel(order="F") + 1e-3
    distances = []
    for _ in range(7):
        inputs, _, memory = step(first, data, ocp.input_lower, ocp.input_upper, memory)
        error = (inputs.full() - best).ravel()
        distances.append(np.sqrt(error @ model @ error))
    measured = np.array(distances[2:]) / distances[1:-1]
    assert measured.max() <= predicted + 0.01
    assert measured[-1] == pytest.approx(predicted, abs=0.01)


def predicted_contraction(ocp, data, first, best):
    inputs = ca.MX.sym("U", 1, ocp.stages)
    none = np.zeros((ocp.state.size, ocp.stages))
    _, slope, states, _ = reduced_gradient(ocp)(first, inputs, data, none)
    hessian = ca.Function("h", [inputs], [ca.jacobian(ca.vec(slope), ca.vec(inputs))])(best).full()
    sensitivity = ca.Function("j", [inputs], [ca.jacobian(ca.vec(states[:, 1:]), ca.vec(inputs))])(best).full()
    trajectory = ca.Function("x", [inputs], [states])(best).full()
    s, u, theta = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("t", ocp.data.size)
    by_state = ca.Function("q", [s, u, theta], [ca.hessian(ocp.stage_cost(s, u, theta)[0], s)[0]])
    by_input = ca.Function("r", [s, u, theta], [ca.hessian(ocp.stage_cost(s, u, theta)[0], u)[0]])
    final = ca.Function("f", [s, theta], [ca.hessian(ocp.terminal_cost(s, theta), s)[0]])
    model = np.zeros_like(hessian)
    for i in range(ocp.stages):
        model[i, i] += float(by_input(trajectory[:, i], best[:, i], data[:, i]))
        rows = sensitivity[2 * i : 2 * i + 2]
        at_end = i + 1 == ocp.stages
        after, diagnostics = trajectory[:, i + 1], data[:, i + 1]
        model += (
            rows.T
            @ (final(after, diagnostics) if at_end else by_state(after, best[:, i + 1], diagnostics)).full()
            @ rows
        )
    return np.abs(1 - np.linalg.eigvals(np.linalg.solve(model, hessian))).max(), model


def test_the_envelope_never_rises():
    """Every accepted plan decreases the envelope, or is the plain step, which decreases it by itself."""
    ocp, data = pendulum_problem(SWING, fp.Limits(inputs={"torque": (-2.0, 2.0)}), fp.Horizon(stages=30, step=0.1))
    optimiser = fp.FixedPoint(iterations=1, tolerance=1e-9)
    search = Search(ocp, GaussNewton(), optimiser.map, 0.0)
    symbols, memory = call_symbols(ocp)
    start = first_anchor(ocp, symbols, memory)
    begin = ca.Function("begin", [*symbols, memory], list(start))
    anchor = [ca.MX.sym(f"a{k}", *v.shape) for k, v in enumerate(start)]
    tried, plan = search.tried(type(start)(*anchor), symbols)
    next_anchor = search.directed(tried, plan, symbols)
    advance = ca.Function("advance", [*symbols, *anchor], [*next_anchor, plan.accepted])
    arguments = np.array([0.1, 0.0]), data, np.array([-2.0]), np.array([2.0])
    state: list[ca.DM] = list(begin(*arguments, optimiser.memory(ocp).start()))
    costs = []
    for _ in range(80):
        *state, accepted = advance(*arguments, *state)
        costs.append((float(state[7]), float(state[9]), bool(accepted)))
    pairs = list(pairwise(costs))
    same_gamma = [(a, b) for a, b in pairs if a[1] == b[1]]
    assert len(same_gamma) > 60
    assert all(b[0] <= a[0] + 1e-10 * abs(a[0]) for a, b in same_gamma)
    assert sum(not c[2] for c in costs) > 0, "the case is hard enough that some plans are rejected"


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
@pytest.mark.parametrize("iterations", [1, 4, 15])
@pytest.mark.parametrize("high", [100.0, 2.0])
def test_driver_and_composed_graph_agree(iterations, high):
    """The loops in C compute what the graph computes, rejected plans and active bounds included."""
    ocp, data = pendulum_problem(SWING, horizon=fp.Horizon(stages=30, step=0.1))
    optimiser = fp.FixedPoint(iterations=iterations, tolerance=1e-9)
    graph = optimiser.step(ocp)
    sources = generate(graph)
    assert len(sources) == 2, "the driver stands in a file of its own"
    assert "_driver(arg, res, iw, " in sources[0]
    compiled = native(graph)
    assert compiled.compiled
    bounds = np.array([-high]), np.array([high])
    memories = [optimiser.memory(ocp).start()] * 2
    for k in range(6):
        first = np.array([0.1 + 0.1 * k, -0.3 * k])
        results = [f(first, data, *bounds, m) for f, m in zip((graph, compiled.function), memories, strict=True)]
        for one, other in zip(*results, strict=True):
            np.testing.assert_allclose(one.full(), other.full(), rtol=1e-6, atol=1e-7)
        memories = [r[2] for r in results]


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
def test_converging_driver_and_graph_stop_together():
    """The same number of iterations, the same plan, and nothing done beyond the tolerance."""
    ocp, data = pendulum_problem(SWING, horizon=fp.Horizon(stages=30, step=0.1))
    optimiser = fp.FixedPoint(iterations=1, tolerance=1e-6)
    graph, start = optimiser.converging(ocp), optimiser.memory(ocp).start()
    arguments = np.array([0.1, 0.0]), data, np.array([-2.0]), np.array([2.0]), start
    results = [[v.full() for v in f(*arguments)] for f in (graph, native(graph).function)]
    assert results[0][1][3] == results[1][1][3]
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-6)
    fixed = replace(optimiser, iterations=int(results[0][1].ravel()[3]))
    np.testing.assert_allclose(fixed.step(ocp)(*arguments)[0].full(), results[0][0], atol=1e-9)


def test_gradient_newton_transition():
    """Large damping makes short safe steps: the same optimum, more iterations."""
    ocp, data, first = linear_problem()
    counts = []
    for damping in (0.0, 1.0, 10.0):
        plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=1e-8, damping=damping), first, data, calls=500)
        assert plan.status == fp.Status.OK
        counts.append(plan.iterations)
    assert counts[0] < counts[1] < counts[2]


def test_a_saturating_map_limits_the_step():
    """With a small scale S the first move is at most S (atanh 1/2 + x*); the optimum is the same."""
    ocp, data, first = linear_problem()
    sigmoid = fp.Sigmoid(gain=-2.5, scale=0.2)
    optimiser = fp.FixedPoint(iterations=1, tolerance=1e-8, map=sigmoid)
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
    near = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=0.1), first, data).inputs
    iterations = {}
    for model in (GaussNewton(), fp.ExactHessian()):
        plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=1e-10, hessian=model), first, data, start=near)
        assert plan.status == fp.Status.OK
        iterations[type(model).__name__] = plan.iterations
    assert iterations["ExactHessian"] <= 5 < 2 * 5 <= iterations["GaussNewton"]


def test_single_iterations_get_out_of_a_bad_plan():
    """A plan whose full, short and plain steps are all too long, one iteration per call: what is learned lasts over calls."""
    plant = fp.Plant(
        coordinates={"height": "m"},
        inputs={"thrust": "N"},
        order=2,
        response=lambda q, v, u, p: {"height": (u.thrust - 0.3 * v.height * ca.fabs(v.height)) / p.mass - 9.81},
        parameters={"mass": fp.Parameter(0.2, 0.2, "kg")},
    )
    reference = fp.Trajectory(lambda t: {"height": 2 + 1.5 * ca.sin(1.2 * t)})
    cost = fp.Quadratic(states={"height": 1e3, "height'": 1.0}, deviation={"thrust": 1e-2})
    horizon, limits = fp.Horizon(stages=20, step=2e-2), fp.Limits(inputs={"thrust": (0.0, 40.0)})
    ocp = transcribe(plant, reference, horizon, cost, limits)
    data = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate).full()
    optimiser, memory = fp.FixedPoint(iterations=1, tolerance=1e-6), None
    first = np.array([2.0, 0.0])
    best = fp.solve(ocp, fp.Ipopt(), first, data)
    # As after a plan for another model: nearly all thrust at once.
    memory = optimiser.memory(ocp).start()
    memory[optimiser.memory(ocp).slice("plan_inputs")] = np.linspace(40.0, 0.0, horizon.stages)
    statuses = []
    for _ in range(40):
        inputs, diagnostics, memory = call(optimiser, ocp, data, first, ocp.input_lower, ocp.input_upper, memory)
        statuses.append(int(diagnostics.ravel()[4]))
    assert statuses[-1] == fp.Status.OK
    np.testing.assert_allclose(inputs, best.inputs, atol=1e-4)


def test_overflowing_models_are_told_and_survived():
    """A model that overflows in every plan: NON_FINITE with a finite plan; then a good first state is solved."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        order=1,
        response=lambda q, u, p: {"y": q.y**3 + u.u * p.gain},
        parameters={"gain": fp.Parameter(1.0, 1.0, "1")},
    )
    reference = fp.Trajectory(lambda t: {"y": 0 * t})
    cost, horizon = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.1}), fp.Horizon(stages=40, step=0.1)
    ocp = transcribe(plant, reference, horizon, cost, fp.Limits(inputs={"u": (-1.0, 1.0)}))
    data = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate).full()
    optimiser = fp.FixedPoint(iterations=6, tolerance=1e-6)
    inputs, diagnostics, memory = call(optimiser, ocp, data, np.array([30.0]), ocp.input_lower, ocp.input_upper)
    assert int(diagnostics.ravel()[4]) == fp.Status.NON_FINITE
    assert np.isfinite(inputs).all()
    for _ in range(4):
        _, diagnostics, memory = call(optimiser, ocp, data, np.array([0.3]), ocp.input_lower, ocp.input_upper, memory)
    assert int(diagnostics.ravel()[4]) == fp.Status.OK


@pytest.mark.parametrize("compiled", [False, True], ids=["virtual machine", "C"])
def test_a_plan_is_begun_anew_where_no_input_leaves_the_model(compiled):
    """Y' = u - 2 sqrt(y) from 0.2 m: without inflow the plan is empty in 0.45 s, and no number comes back from there.

    A remembered plan without inflow is NON_FINITE once; the next call begins in the middle of the limits and is solved.
    """
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "m/s"},
        order=1,
        response=lambda q, u, p: {"y": p.gain * u.u - 2 * ca.sqrt(q.y)},
        parameters={"gain": fp.Parameter(1.0, 1.0, "1")},
    )
    reference = fp.Trajectory(lambda t: {"y": 0.3 + 0 * t})
    cost, horizon = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.01}), fp.Horizon(stages=20, step=0.05)
    ocp = transcribe(plant, reference, horizon, cost, fp.Limits(inputs={"u": (0.0, 3.0)}))
    data = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate).full()
    optimiser = fp.FixedPoint(iterations=20, tolerance=1e-6)
    step = optimiser.step(ocp)
    step = native(step).function if compiled else step
    memory, statuses = np.zeros(optimiser.memory(ocp).size), []
    for _ in range(3):
        _, diagnostics, memory = step(np.array([0.2]), data, ocp.input_lower, ocp.input_upper, memory)
        statuses.append(fp.Status(int(diagnostics.full().ravel()[4])))
    assert statuses[0] == fp.Status.NON_FINITE
    assert statuses[-1] == fp.Status.OK


def test_feedback_keeps_unstable_plants_together():
    """An unstable plant over a long horizon, warm-started from a disturbed state: without the remembered feedback it overflows."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        order=1,
        response=lambda q, u, p: {"y": 3 * q.y + 0.5 * q.y**3 + u.u * p.gain},
        parameters={"gain": fp.Parameter(1.0, 1.0, "1")},
    )
    reference = fp.Trajectory(lambda t: {"y": 0 * t})
    cost, horizon = fp.Quadratic(states={"y": 1.0}, effort={"u": 0.1}), fp.Horizon(stages=60, step=0.1)
    ocp = transcribe(plant, reference, horizon, cost, fp.Limits())
    data = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate).full()
    optimiser = fp.FixedPoint(iterations=3, tolerance=1e-6)
    _, _, memory = call(optimiser, ocp, data, np.zeros(1), ocp.input_lower, ocp.input_upper)
    _, diagnostics, _ = call(optimiser, ocp, data, np.array([0.1]), ocp.input_lower, ocp.input_upper, memory)
    assert diagnostics.ravel()[1] < 1.0
    without = np.where(np.arange(memory.size) < ocp.stages, memory.ravel(), 0.0)
    _, diagnostics, _ = call(optimiser, ocp, data, np.array([0.1]), ocp.input_lower, ocp.input_upper, without)
    assert int(diagnostics.ravel()[4]) != fp.Status.OK


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"iterations": 0}, "iterations: expected a whole number from 1"),
        ({"tolerance": 0.0}, "tolerance: expected a finite number above 0"),
        ({"damping": -1.0}, "damping"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        fp.FixedPoint(**{"iterations": 1, "tolerance": 1e-6, **settings})


MAGNET = fp.Plant(
    coordinates={"gap": "m"},
    inputs={"current": "A"},
    order=2,
    response=lambda q, v, u, p: {"gap": 9.81 - p.inductance / (2 * p.mass) * (u.current / q.gap) ** 2},
    parameters={"inductance": fp.Parameter(2.0e-4, 1.4e-4, "H m"), "mass": fp.Parameter(0.06, 0.06, "kg")},
)


@pytest.mark.parametrize("gap", [8e-3, 9e-3 - 1e-9, 9e-3, 9e-3 + 1e-9, 9.00001e-3, 12e-3, 14.75e-3])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-6])
def test_at_rest_on_the_reference_the_first_plan_is_the_feedforward(gap, tolerance):
    """Without current a change of it does nothing, so the gradient of the zero plan is small: that is no certificate."""
    reference, forward = fp.Trajectory(lambda t: {"gap": gap + 0 * t}), gap * np.sqrt(9.81 * 2 * 0.06 / 2e-4)
    cost = fp.Quadratic(states={"gap": 1e6, "gap'": 1e2}, deviation={"current": 1.0})
    horizon, limits = fp.Horizon(stages=20, step=5e-3), fp.Limits(inputs={"current": (0.0, 3.0)})
    ocp = transcribe(MAGNET, reference, horizon, cost, limits)
    data, first = stage_data(MAGNET, reference, horizon, cost)(0.0, MAGNET.approximate).full(), np.array([gap, 0.0])
    optimiser = fp.FixedPoint(iterations=1, tolerance=tolerance)
    layout = optimiser.memory(ocp)
    bounds = ocp.input_lower, ocp.input_upper
    inputs, diagnostics, _ = (v.full() for v in optimiser.converging(ocp)(first, data, *bounds, layout.start()))
    assert diagnostics.ravel()[4] == fp.Status.OK
    np.testing.assert_allclose(inputs, forward, atol=tolerance)
    remembered = layout.unpack(optimiser.first_memory(ocp, first, data))["plan_inputs"]
    np.testing.assert_allclose(remembered, forward, atol=tolerance)
