"""Fixed-point iteration with limits of states: other people's plants, random linear plants, infeasible horizons, loops, tables."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from foreign import FOREIGN, first_states
from helpers.horizons import called, horizon_of, rolled
from helpers.kinds import slow_but
from helpers.machine import needs_compiler
from helpers.plants import known
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, nnls

import fpirhc as fp
from fpirhc.conformance import compiled, posed

# The horizon's first state as in the recorded loops, and IPOPT's cost there at an accuracy of 1e-9; its limits are relaxed by 1e-8.
OPTIMA = {
    "quadrotor": 5.135754,
    "arm": 8.4693284,
    "reactor": 0.2374208,
    "tanks": 5.2403801,
    "bicycle": 0.69842594,
    "body": 5.7773322,
    "crane": 5.1111266,
    "pendulum": 1.3459087,
    "servo": 28.432632,
    "double_tank": 47.481817,
}


def first_horizon(name):
    case = FOREIGN[name]()
    ocp, data = horizon_of(case.plant, case.reference, case.horizon, case.cost, case.limits)
    start = np.array([case.start.get(e, 0.0) for e in case.plant.state.elements])
    return ocp, data, case.first(ocp, start)


def tolerance_of(ocp):
    return 1e-7 * float((0.5 * (ocp.input_upper - ocp.input_lower)).min())


def solved(ocp, first, data):
    return fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=tolerance_of(ocp)), first, data)


def is_stationary(ocp, inputs, first, data, residual=1e-6):
    judged = Judge(ocp)(inputs, first, data)
    assert (judged.residual <= residual, judged.violation <= 1e-6) == (True, True), judged


@pytest.mark.parametrize("name", slow_but(OPTIMA, *list(OPTIMA)[::3]))
def test_horizons_of_other_people_are_solved_from_nothing(name):
    """IPOPT's cost, inside all limits, and stationary to a judge that knows neither sweeps nor multipliers."""
    ocp, data, first = first_horizon(name)
    plan = solved(ocp, first, data)
    assert plan.status == fp.Status.OK
    assert plan.calls == 1
    is_stationary(ocp, plan.inputs, first, data)
    assert plan.cost == pytest.approx(OPTIMA[name], rel=3e-5)


def test_nine_states_and_three_inputs_with_walls_have_the_optimum_of_ipopt():
    """The chain of masses of Wirsching, Bock and Diehl below a ceiling and behind a wall: from nothing, in one call."""
    p, states = fp.load_problem("chain_of_masses").problem, {"z1": (-0.22, 5.0), "xe": (-5.0, 1.0)}
    ocp, first, data = posed(replace(p, limits=fp.Limits(inputs=p.limits.inputs, states=states)))
    plan = solved(ocp, first, data)
    best = fp.solve(ocp, fp.Ipopt(accuracy=1e-9), first, data)
    is_stationary(ocp, plan.inputs, first, data)
    assert (ocp.state.size, plan.status, plan.calls) == (9, fp.Status.OK, 1)
    assert known(plan.cost) == pytest.approx(known(best.cost), rel=1e-7)
    places = [ocp.state.elements.index(name) for name in states]
    room = np.minimum(plan.states.T - ocp.state_lower, ocp.state_upper - plan.states.T)[1:, places]
    assert room.min() < 1e-6


@pytest.mark.parametrize("speed", [1.0, 1.2, 1.4])
def test_a_wall_that_the_inputs_feel_late_is_solved_in_one_call(speed):
    """The quadrotor flies towards x = .3 m: its position is held by a limit of its tilt, four integrations away.

    Multipliers of neighbouring stages are nearly dependent: the barrier must go down to 1e-13 and less.
    """
    case, first = FOREIGN["quadrotor"](), np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])
    limits = fp.Limits(inputs=dict(case.limits.inputs), states={"tilt": (-0.35, 0.35), "x": (-3.0, 0.3)})
    ocp, data = horizon_of(case.plant, case.reference, case.horizon, case.cost, limits)
    plan = solved(ocp, first, data)
    best = fp.solve(ocp, fp.Ipopt(accuracy=1e-9), first, data)
    assert (plan.status, plan.calls) == (fp.Status.OK, 1)
    assert known(plan.cost) == pytest.approx(known(best.cost), rel=1e-6)
    assert plan.states[0].max() == pytest.approx(0.3, abs=1e-7)


@cache
def linear_horizon():
    """Two states and two inputs whose every coefficient is a parameter: one horizon serves all plants."""
    names = [f"a{i}{j}" for i in range(2) for j in range(2)] + [f"b{i}{j}" for i in range(2) for j in range(2)]

    def response(q, u, p):
        x, v = [q.x1, q.x2], [u.u1, u.u2]
        rows = [sum(p[f"a{i}{j}"] * x[j] + p[f"b{i}{j}"] * v[j] for j in range(2)) for i in range(2)]
        return {"x1": rows[0], "x2": rows[1]}

    plant = fp.Plant(
        coordinates={"x1": "m", "x2": "m"},
        inputs={"u1": "N", "u2": "N"},
        order=1,
        response=response,
        parameters={n: fp.Parameter(*[float(n in ("b00", "b11"))] * 2, "1") for n in names},
    )
    cost = fp.Quadratic(states={"x1": 1.0, "x2": 0.3}, effort={"u1": 0.1, "u2": 0.3})
    limits = fp.Limits(inputs={"u1": (-1.0, 1.0), "u2": (-0.7, 0.9)}, states={"x1": (-0.5, 0.6), "x2": (-0.8, 0.5)})
    reference = fp.Trajectory(lambda t: {"x1": 0.7 * ca.sin(2 * t), "x2": 0.6 * ca.cos(3 * t)})
    horizon, start = fp.Horizon(stages=12, step=0.1), {"x1": 0.0, "x2": 0.0}
    problem = fp.Problem(plant, reference, start, 0.1, 0.1, limits=limits, horizon=horizon, cost=cost)
    ocp, optimiser = posed(problem)[0], fp.FixedPointSolver(iterations=1, tolerance=1e-9)
    return problem, compiled(optimiser.converging(ocp)), optimiser.memory(ocp).start()


def drawn(seed):
    """A random plant: its horizon, first state and data, and the plan's inputs and five numbers."""
    problem, step, start = linear_horizon()
    random = np.random.default_rng(seed)
    parameters = np.concatenate([random.normal(size=4) * 1.5, np.eye(2).ravel() + 0.4 * random.normal(size=4)])
    ocp, _, data = posed(problem, parameters=parameters)
    first = random.uniform([-0.5, -0.8], [0.6, 0.5])
    inputs, numbers, _ = called(step, first, data, ocp.input_lower, ocp.input_upper, start)
    return ocp, first, data, inputs, numbers[:, 0]


def condensed(ocp, first, data):
    """The horizon as a quadratic program in the inputs, by automatic differentiation: solution of OSQP."""
    n, nu = ocp.stages, ocp.input.size
    inputs, s, total, states = ca.MX.sym("U", nu * n), ca.MX(first), 0, []
    for i in range(n):
        u = inputs[i * nu : (i + 1) * nu]
        total += ocp.stage_cost(s, u, data[:, i])[0]
        s = ocp.dynamics(s, u, data[:, i])
        states.append(s)
    total += ocp.terminal_cost(s, data[:, n])
    hessian, slope = ca.hessian(total, inputs)
    rows = ca.vertcat(*states)
    values = ca.Function("f", [inputs], [hessian, slope, ca.jacobian(rows, inputs), rows, total])
    h, g, a, at, _ = (np.asarray(v.full()) for v in values(np.zeros(nu * n)))
    solver = ca.conic("qp", "osqp", {"h": ca.DM(h).sparsity(), "a": ca.DM(a).sparsity()}, EXACT)
    result = solver(
        h=h,
        g=g,
        a=a,
        lba=np.tile(ocp.state_lower, n) - at.ravel(),
        uba=np.tile(ocp.state_upper, n) - at.ravel(),
        lbx=np.tile(ocp.input_lower, n),
        ubx=np.tile(ocp.input_upper, n),
    )
    return solver.stats()["success"], np.asarray(result["x"].full()).ravel(), float(values(result["x"])[4])


SETTINGS = {"verbose": False, "polish": True, "eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 200_000}
EXACT = {"osqp": SETTINGS, "error_on_fail": False}


def test_random_linear_plants_have_the_optimum_of_a_quadratic_program():
    """Stable and unstable plants, boxes of states and inputs: the same cost to 1e-7; the status says where no plan fits."""
    met: list[bool] = []

    @settings(deadline=None, derandomize=True, max_examples=30)
    @given(seed=st.integers(0, 10**6))
    def law(seed):
        met.append(same_optimum(seed))

    law()
    assert 10 < sum(met) < len(met)  # plants with a plan and plants without


def same_optimum(seed: int) -> bool:
    """Compare the plan of one random plant with the quadratic program's; whether there is a plan."""
    ocp, first, data, inputs, numbers = drawn(seed)
    solvable, best, value = condensed(ocp, first, data)
    if solvable:
        assert int(numbers[4]) == fp.Status.OK
        assert numbers[0] == pytest.approx(value, rel=1e-7, abs=1e-9)
        np.testing.assert_allclose(inputs.ravel(order="F"), best, atol=1e-5)
    else:
        assert int(numbers[4]) != fp.Status.OK
    return solvable


def test_what_the_roll_out_of_a_solved_plan_adds_to_a_limit_is_no_failure():
    """A rocket's plan with gaps keeps its limits to 1e-8 of their ranges, and rolled out to 4e-8: OK, whole and alone."""
    case, number = FOREIGN["rocket"](), 112
    ocp, data = horizon_of(case.plant, case.reference, case.horizon, case.cost, case.limits, time=11.2)
    start = case.first(ocp, first_states(case, 150, 3)[:, number])
    near = start * (1 + 1e-3 * np.random.default_rng(number).normal(size=start.size))
    limited = np.isfinite(ocp.state_lower)
    low, high = ocp.state_lower[limited, None], ocp.state_upper[limited, None]
    graph = (optimiser := fp.FixedPointSolver(tolerance=2e-3)).step(ocp)
    for step in (graph, compiled(graph)):
        memory = optimiser.memory(ocp).start()
        for first in (start, near):
            plan, diagnostics, after = step(first, data, ocp.input_lower, ocp.input_upper, memory)
            memory = ca.evalf(optimiser.shifted(ocp, ca.MX(after)))
        states = rolled(ocp, near, np.asarray(plan.full()), data).states[limited, 1:]
        worst = (np.maximum(low - states, states - high) / (0.5 * (high - low))).max()
        assert (1e-8 < worst < 1e-7, int(diagnostics[4])) == (True, fp.Status.OK)


def least_violation(ocp, first, data):
    """The smallest largest violation of the states' limits by inputs within theirs, by a linear program (HiGHS)."""
    n, nu = ocp.stages, ocp.input.size

    def states(inputs):
        return rolled(ocp, first, inputs.reshape(n, nu).T, data).states[:, 1:].T.ravel()

    rest = states(np.zeros(nu * n))
    rows = np.column_stack([states(one) - rest for one in np.eye(nu * n)])
    upper, lower = np.tile(ocp.state_upper, n) - rest, np.tile(ocp.state_lower, n) - rest
    give, box = -np.ones((len(rest), 1)), zip(np.tile(ocp.input_lower, n), np.tile(ocp.input_upper, n), strict=True)
    found = linprog(
        np.r_[np.zeros(nu * n), 1.0],
        A_ub=np.block([[rows, give], [-rows, give]]),
        b_ub=np.r_[upper, -lower],
        bounds=[*box, (0, None)],
    )
    return float(found.x[-1])


def test_a_linear_horizon_is_infeasible_where_a_linear_program_says_so():
    """In both directions, also of unstable plants whose limits are violated by ten times their size and more."""
    told = set()
    for seed in range(200, 225):
        ocp, first, data, _, numbers = drawn(seed)
        least = least_violation(ocp, first, data)
        assert numbers[4] == (fp.Status.INFEASIBLE if least > 1e-7 else fp.Status.OK), (seed, least)
        told.add(numbers[4])
    assert len(told) == 2


def test_a_horizon_that_cannot_be_kept_ends_with_the_least_violation():
    """The reactor begins above its limit and cannot cool at once: INFEASIBLE, and no plan violates the limit less in sum."""
    ocp, data, first = first_horizon("reactor")
    hot = first + np.array([0.0, 10.0, 0.0])
    plan = solved(ocp, hot, data)
    assert plan.status == fp.Status.INFEASIBLE
    beyond = np.maximum(plan.states[1, 1:] - 351.5, 0).sum()
    assert beyond > 1e-3
    assert "'T' is" in plan.violations()[0]
    coldest = np.asarray(ocp.dynamics(hot, 280.0, data[:, 0]).full()).ravel()
    assert plan.states[1, 1] == pytest.approx(coldest[1], abs=1e-6)
    assert plan.inputs[0, 0] == pytest.approx(280.0, abs=1e-6)


@pytest.mark.parametrize("start", [3, 13])
def test_horizons_with_limits_of_inputs_only_are_rescued(start):
    """An unstable reactor, cold: the plain iteration ends at a hundred times the cost, the solve at IPOPT's, and goes on there."""
    case = FOREIGN["reactor"]()
    ocp, data = horizon_of(case.plant, case.reference, case.horizon, case.cost, fp.Limits(inputs=case.limits.inputs))
    first, optimiser = case.first(ocp, first_states(case, 40, 3)[:, start]), fp.FixedPointSolver(1, tolerance_of(ocp))
    call = first, data, ocp.input_lower, ocp.input_upper, optimiser.memory(ocp).start()
    plain, plan = optimiser.converging(ocp)(*call), fp.solve(ocp, optimiser, first, data)
    solved, numbers, memory = optimiser.improve(ocp, call)
    assert plan.iterations == int(numbers[3, 0]) > float(plain[1][3])
    np.testing.assert_allclose(optimiser.step(ocp)(*call[:4], memory)[0].full(), solved, rtol=1e-9)
    other = fp.solve(ocp, fp.Ipopt(accuracy=1e-9), first, data, calls=2)
    assert int(plain[1][4]) != fp.Status.OK == plan.status
    assert float(plain[1][0]) > 100 * known(plan.cost)
    assert known(plan.cost) <= known(other.cost) * (1 + 3e-5)
    is_stationary(ocp, plan.inputs, first, data)


@cache
def _run_in_units(cost=1.0, force=1.0, length=1.0, time=1.0):
    """Commands and statuses of a mass between limits of its position, its model wrong, in other units; in newtons."""

    def response(q, v, u, p):
        pull = u.F / force - p.b * v.q * time / length - p.k * q.q / length
        return {"q": length / time**2 * pull / p.m}

    parameters = {"m": fp.Parameter(1.5, 1.0, "kg"), "b": fp.Parameter(0.0, 0.2, "1"), "k": fp.Parameter(1.0, 2.0, "1")}
    problem = fp.Problem(
        plant=fp.Plant(coordinates={"q": "m"}, inputs={"F": "N"}, order=2, response=response, parameters=parameters),
        reference=fp.Trajectory(lambda t: {"q": 0.3 * length * ca.sin(2 * t / time)}),
        start={"q": 0.05 * length},
        period=1e-2 * time,
        duration=1.5 * time,
        limits=fp.Limits(inputs={"F": (-8 * force, 8 * force)}, states={"q": (-0.25 * length, 0.25 * length)}),
        horizon=fp.Horizon(stages=10, step=2e-2 * time),
        cost=fp.Quadratic(
            states={"q": 1e3 * cost / length**2, "q'": cost * time**2 / length**2},
            deviation={"F": 1e-3 * cost / force**2},
        ),
    )
    run = fp.simulate(problem, fp.RecedingHorizon(fp.FixedPointSolver()), seed=0, compiled=False)
    return np.ravel(run["command.F"]) / force, np.ravel(run["status"])


@pytest.mark.parametrize("seed", slow_but(range(60), 0, 1))
def test_commands_do_not_depend_on_the_units(seed):
    """Random units of cost, force, length and time: what counts as kept and as solved is a share of the limits."""
    cost, force, length, time = 10.0 ** np.random.default_rng(seed).uniform([-6, -4, -6, -3], [6, 4, 6, 3])
    (command, status), (other, after) = _run_in_units(), _run_in_units(cost, force, length, time)
    np.testing.assert_allclose(other, command, atol=8e-6)
    np.testing.assert_array_equal(after, status)


# Loops: every call ends where its plan is solved, or says what is the matter within its most iterations
@pytest.mark.parametrize("iterations", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_every_plan_of_a_loop_with_a_wrong_model_is_converged(iterations):
    """The quadrotor, 13 % lighter than its model: what `iterations` says without limits of states does not matter with them."""
    case = FOREIGN["quadrotor"]()
    own = {k: v for k, v in case.start.items() if k in case.plant.coordinates}
    planned = {"limits": case.limits, "horizon": case.horizon, "cost": case.cost}
    start = dict.fromkeys(case.plant.coordinates, 0.0) | own
    p = fp.Problem(case.plant, case.reference, start, case.horizon.step, duration=3.0, **planned)
    run = fp.simulate(p, fp.RecedingHorizon(fp.FixedPointSolver(iterations, tolerance=1e-4)), seed=0)
    assert run.stop is None
    assert set(fp.measure(p, run).statuses) == {"OK"}
    lower, upper = p.limits.state_bounds(p.plant)
    half = 0.5 * (upper - lower)
    beyond = np.maximum(run["state"] - upper, lower - run["state"]) / np.where(np.isfinite(half), half, 1.0)
    assert beyond.max() <= 0.2


def test_a_remembered_plan_of_a_state_that_moved_beyond_its_limit_is_told_in_few_iterations():
    """Jumps of the temperature by up to 6 K, and back: the plan and the verdict are those from nothing, INFEASIBLE above 3 K."""
    ocp, data, first = first_horizon("reactor")
    optimiser, bounds, verdicts = fp.FixedPointSolver(tolerance=1e-3), (ocp.input_lower, ocp.input_upper), []
    step, rest = compiled(optimiser.step(ocp)), optimiser.memory(ocp).start()
    memory = optimiser.improve(ocp, (first, data, *bounds, rest))[2]
    for jump in (3.0, 5.0, -3.0, 6.0, 0.0, 4.0, -5.0):
        moved = first + np.array([0.0, jump, 0.0])
        _, diagnostics, memory = called(step, moved, data, *bounds, memory)
        fresh = called(step, moved, data, *bounds, rest)[1]
        assert diagnostics[4, 0] == fresh[4, 0]
        assert diagnostics[3, 0] < 40
        verdicts.append(int(diagnostics[4, 0]) == fp.Status.INFEASIBLE)
        assert diagnostics[0, 0] == pytest.approx(fresh[0, 0], rel=1e-4)
    assert verdicts == [False, True, False, True, False, True, False]


# A model that looks up a table plans in C too: its loops give the leaves room for their work
INPUTS, STATES = {"F": (-6.0, 6.0)}, {"x'": (-1.2, 0.8)}


@needs_compiler
@pytest.mark.parametrize("limits", [fp.Limits(INPUTS), fp.Limits(INPUTS, states=STATES)], ids=["inputs", "states"])
def test_a_plan_of_a_model_with_a_table_is_solved_in_c(limits):
    """Drag from measured points: the plan is stationary to a judge of its own, and without limits of states that of the graph."""
    table = ca.interpolant("drag", "bspline", [[-3.0, -1.0, 0.0, 1.0, 3.0]], [-4.0, -0.6, 0.0, 0.6, 4.0])
    mass, reference = {"m": fp.Parameter(1.0, 1.0, "kg")}, fp.Trajectory(lambda t: {"x": 0.8 * ca.sin(2 * t)})
    plant = fp.Plant({"x": "m"}, {"F": "N"}, mass, lambda q, v, u, p: {"x": (u.F - table(v.x)) / p.m})
    cost = fp.Quadratic(states={"x": 30.0, "x'": 0.3}, effort={"F": 1e-2})
    ocp, data = horizon_of(plant, reference, fp.Horizon(stages=10, step=0.1), cost, limits)
    optimiser, first = fp.FixedPointSolver(tolerance=1e-7), np.array([0.4, 0.5])
    graph = optimiser.converging(ocp)
    arguments = first, data, ocp.input_lower, ocp.input_upper, optimiser.memory(ocp).start()
    (plan, numbers, _), (same, *_) = called(compiled(graph), *arguments), called(graph, *arguments)
    assert int(numbers[4, 0]) == fp.Status.OK
    np.testing.assert_allclose(plan, same, atol=1e-7)
    is_stationary(ocp, plan, first, data, residual=1e-5)


_MET = 1e-6  # of the range: nearer limits may have a multiplier


@dataclass(frozen=True)
class Judgement:
    """cost; residual of the first-order conditions; violation, relative to the limits' half ranges; all by rolling out."""

    cost: float
    residual: float
    violation: float


class Judge:
    """An independent judge of any optimiser's plan of one problem: the first-order conditions by dense algebra.

    The plan is rolled out; the gradient g and the sensitivity J of the limited states come from CasADi's automatic differentiation
    of the rolled-out cost, not from any sweep. Multipliers of every limit that is met to 1e-6 of its range are fitted by
    non-negative least squares, and the residual is the largest entry of

        gamma (g - sum z_i sign_i dw_i/dU) / (half range),      gamma = (half range)^2 / C.
    """

    def __init__(self, ocp: Any) -> None:
        s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, ocp.stages + 1)
        inputs, states, value = ca.MX.sym("U", ocp.input.size, ocp.stages), [s0], 0
        for k in range(ocp.stages):
            value += ocp.stage_cost(states[-1], inputs[:, k], data[:, k])[0]
            states.append(ocp.dynamics(states[-1], inputs[:, k], data[:, k]))
        value += ocp.terminal_cost(states[-1], data[:, ocp.stages])
        bounded = np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper)).tolist()
        limited, flat = ca.vec(ca.horzcat(*states[1:])[bounded, :]), ca.vec(inputs)
        results = [value, limited, ca.gradient(value, flat), ca.densify(ca.jacobian(limited, flat))]
        self._values = ca.Function("values", [s0, inputs, data], results)
        lower, upper = (
            np.concatenate([np.tile(own, ocp.stages), np.tile(state[bounded], ocp.stages)])
            for own, state in ((ocp.input_lower, ocp.state_lower), (ocp.input_upper, ocp.state_upper))
        )
        half = 0.5 * (upper - lower)
        self._lower, self._upper, self._unit = lower, upper, np.where(np.isfinite(half) & (half > 0), half, 1.0)
        own = self._unit[: ocp.input.size]
        self._weight = np.tile(own / np.median(own**2 / ocp.scale), ocp.stages)

    def __call__(self, inputs: np.ndarray, s0: np.ndarray, data: np.ndarray) -> Judgement:
        """Return what is known about a plan (nu, N)."""
        value, limited, slope, sensitivity = (np.asarray(v.full()) for v in self._values(s0, inputs, data))
        if not all(np.isfinite(v).all() for v in (limited, slope, sensitivity)):
            return Judgement(np.inf, np.inf, np.inf)
        values, unit = np.concatenate([inputs.ravel(order="F"), limited.ravel()]), self._unit
        violation = max(((self._lower - values) / unit).max(), ((values - self._upper) / unit).max(), 0.0)
        low, high = values <= self._lower + _MET * unit, values >= self._upper - _MET * unit
        jacobian = np.vstack([np.eye(inputs.size), sensitivity])
        columns = np.vstack([jacobian[low], -jacobian[high]]).T
        residual = _left(self._weight[:, None] * columns, self._weight * slope.ravel())
        return Judgement(float(value.item()), residual, float(violation))


def _left(columns: np.ndarray, target: np.ndarray) -> float:
    """Largest entry of columns z - target for the best z >= 0."""
    if not columns.size:
        return float(np.abs(target).max())
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    try:
        best, _ = nnls(columns / size, target, maxiter=30 * columns.shape[1])
    except RuntimeError:
        return float("inf")
    return float(np.abs(columns / size @ best - target).max())
