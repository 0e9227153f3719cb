"""Fixed-point iteration with limits of states: other people's plants, random linear plants, infeasible horizons."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from foreign import FOREIGN, first_states
from helpers.kinds import slow_but
from helpers.plants import known
from hypothesis import given, settings
from hypothesis import strategies as st
from judging import Judge

import fpirhc as fp
from fpirhc.horizon.problem import curvature_at_rest
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.bounds import scales
from fpirhc.optimisers.limited import limited_step
from fpirhc.symbolic.native import find_compiler, native

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
    ocp = transcribe(case.plant, case.reference, case.horizon, case.cost, case.limits)
    data = stage_data(case.plant, case.reference, case.horizon, case.cost)(0.0, case.plant.approximate)
    start = np.array([case.start.get(e, 0.0) for e in case.plant.state.elements])
    return ocp, np.asarray(data.full()), case.first(ocp, start)


def tolerance_of(ocp):
    return 1e-7 * float((0.5 * (ocp.input_upper - ocp.input_lower)).min())


@pytest.mark.parametrize("name", slow_but(OPTIMA, *list(OPTIMA)[::2]))
def test_horizons_of_other_people_are_solved_from_nothing(name):
    """IPOPT's cost, inside all limits, and stationary to a judge that knows neither sweeps nor multipliers."""
    ocp, data, first = first_horizon(name)
    plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=tolerance_of(ocp)), first, data)
    assert plan.status == fp.Status.OK
    assert plan.calls == 1
    judged = Judge(ocp)(plan.inputs, first, data)
    assert judged.residual <= 1e-6
    assert judged.violation <= 1e-6
    assert plan.cost == pytest.approx(OPTIMA[name], rel=3e-5)


WALLS = {"a wall": {"y1": (-0.02, 5.0)}, "ceiling and wall": {"z1": (-0.22, 5.0), "xe": (-5.0, 1.0)}}
WALLS["speeds"] = {"y1'": (-0.97, 0.27), "z1'": (-1.0, 0.26), "x1'": (-0.36, 1.04)}


@pytest.mark.parametrize(
    "name", ["ceiling and wall", *(pytest.param(n, marks=pytest.mark.slow) for n in ("a wall", "speeds"))]
)
def test_nine_states_and_three_inputs_with_walls_have_the_optimum_of_ipopt(name):
    """The chain of masses of Wirsching, Bock and Diehl behind walls: from nothing, in one call, with a limit active."""
    p, states = fp.load_problem("chain_of_masses").problem, WALLS[name]
    assert p.horizon is not None
    assert p.cost is not None
    ocp = transcribe(p.plant, p.reference, p.horizon, p.cost, fp.Limits(inputs=p.limits.inputs, states=states))
    data = np.asarray(stage_data(p.plant, p.reference, p.horizon, p.cost)(0.0, p.plant.approximate).full())
    first = np.asarray(ocp.start(p.start_state, np.zeros(3)).full()).ravel()
    plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=tolerance_of(ocp)), first, data)
    best = fp.solve(ocp, fp.Ipopt(accuracy=1e-9), first, data)
    judged = Judge(ocp)(plan.inputs, first, data)
    assert (ocp.state.size, plan.status, plan.calls) == (9, fp.Status.OK, 1)
    assert judged.residual <= 1e-6
    assert judged.violation <= 1e-6
    assert known(plan.cost) == pytest.approx(known(best.cost), rel=1e-7)
    places = [ocp.state.elements.index(name) for name in states]
    room = np.minimum(plan.states.T - ocp.state_lower, ocp.state_upper - plan.states.T)[1:, places]
    assert room.min() < 1e-6


def behind_a_wall(speed: float):
    """The quadrotor flies towards a wall at x = .3 m: its position is held by a limit of its tilt, four integrations away."""
    case = FOREIGN["quadrotor"]()
    limits = fp.Limits(inputs=dict(case.limits.inputs), states={"tilt": (-0.35, 0.35), "x": (-3.0, 0.3)})
    ocp = transcribe(case.plant, case.reference, case.horizon, case.cost, limits)
    data = np.asarray(
        stage_data(case.plant, case.reference, case.horizon, case.cost)(0.0, case.plant.approximate).full()
    )
    return ocp, data, np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])


@pytest.mark.parametrize("speed", [1.0, 1.2, 1.4])
def test_a_wall_that_the_inputs_feel_late_is_solved_in_one_call(speed):
    """Multipliers of neighbouring stages are nearly dependent: the barrier must go down to 1e-13 and less."""
    ocp, data, first = behind_a_wall(speed)
    plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=tolerance_of(ocp)), first, data)
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
        parameters={n: fp.Parameter(float(n in ("b00", "b11")), 0.0, "1") for n in names},
    )
    cost = fp.Quadratic(states={"x1": 1.0, "x2": 0.3}, effort={"u1": 0.1, "u2": 0.3})
    limits = fp.Limits(inputs={"u1": (-1.0, 1.0), "u2": (-0.7, 0.9)}, states={"x1": (-0.5, 0.6), "x2": (-0.8, 0.5)})
    reference = fp.Trajectory(lambda t: {"x1": 0.7 * ca.sin(2 * t), "x2": 0.6 * ca.cos(3 * t)})
    horizon = fp.Horizon(stages=12, step=0.1)
    ocp = transcribe(plant, reference, horizon, cost, limits)
    data_of = stage_data(plant, reference, horizon, cost)
    optimiser = fp.FixedPoint(iterations=1, tolerance=1e-9)
    return ocp, data_of, native(optimiser.converging(ocp)).function, optimiser.memory(ocp).start()


def condensed(ocp, first, data):
    """The horizon as a quadratic program in the inputs, by automatic differentiation: solution of CasADi's active-set method."""
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
    solver = ca.conic("qp", "qrqp", {"h": ca.DM(h).sparsity(), "a": ca.DM(a).sparsity()}, QUIET)
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


QUIET = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}


def test_random_linear_plants_have_the_optimum_of_a_quadratic_program():
    """Stable and unstable plants, boxes of states and inputs: the same cost to 1e-7; the status says where no plan fits."""
    met: list[bool] = []

    @settings(deadline=None, derandomize=True, max_examples=60)
    @given(seed=st.integers(0, 10**6))
    def law(seed):
        met.append(same_optimum(seed))

    law()
    assert 20 < sum(met) < len(met)  # plants with a plan and plants without


def same_optimum(seed: int) -> bool:
    """Compare the plan of one random plant with the quadratic program's; whether there is a plan."""
    ocp, data_of, step, start = linear_horizon()
    random = np.random.default_rng(seed)
    parameters = np.concatenate([random.normal(size=4) * 1.5, np.eye(2).ravel() + 0.4 * random.normal(size=4)])
    data = np.asarray(data_of(0.0, parameters).full())
    first = random.uniform([-0.5, -0.8], [0.6, 0.5])
    inputs, diagnostics, _ = (np.asarray(v.full()) for v in step(first, data, ocp.input_lower, ocp.input_upper, start))
    solvable, best, value = condensed(ocp, first, data)
    if solvable:
        assert int(diagnostics[4, 0]) == fp.Status.OK
        assert diagnostics[0, 0] == pytest.approx(value, rel=1e-7, abs=1e-9)
        np.testing.assert_allclose(inputs.ravel(order="F"), best, atol=1e-5)
    else:
        assert int(diagnostics[4, 0]) != fp.Status.OK
    return solvable


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
@pytest.mark.parametrize("iterations", [300, 4])
def test_driver_and_graph_agree_with_limits(iterations):
    """The loops in C and the composed graph do the same turns: cold, warm, and from a first state outside its limits."""
    ocp, data, first = first_horizon("reactor")
    graph = limited_step(ocp, fp.FixedPoint(1, tolerance_of(ocp))._limited(ocp, iterations))
    compiled = native(graph)
    assert compiled.compiled
    memories = [np.zeros(graph.size1_in(4))] * 2
    for k in range(4):
        values = first + np.array([0.0, 0.6 * k, 0.0]), data, ocp.input_lower, ocp.input_upper
        results = [f(*values, m) for f, m in zip((graph, compiled.function), memories, strict=True)]
        (one, diagnostics, _), (other, other_diagnostics, _) = results
        np.testing.assert_array_equal(diagnostics.full()[3:], other_diagnostics.full()[3:])
        np.testing.assert_allclose(diagnostics.full()[:3], other_diagnostics.full()[:3], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(one.full(), other.full(), atol=1e-5)
        memories = [r[2] for r in results]


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
@pytest.mark.parametrize("number", [34, 38])
def test_descents_solve_what_the_filter_gives_up(number):
    """A reactor that already ignites, with limits of its coolant only: no first plan gets through the filter."""
    case = FOREIGN["reactor"]()
    reference = fp.Trajectory(lambda t: {"C": 0.5 + 0 * t, "T": 350 + 0 * t})
    case = replace(case, limits=fp.Limits(inputs=case.limits.inputs), spread={"T": 20.0, "C": 0.4})
    ocp = transcribe(case.plant, reference, case.horizon, case.cost, case.limits)
    data = stage_data(case.plant, reference, case.horizon, case.cost)(0.0, case.plant.approximate)
    first = case.first(ocp, first_states(case, 100, 1)[:, number])
    graph = limited_step(ocp, fp.FixedPoint(1, tolerance_of(ocp))._limited(ocp, 1000))
    values = first, data, ocp.input_lower, ocp.input_upper, np.zeros(graph.size1_in(4))
    (one, diagnostics, _), (other, other_diagnostics, _) = graph(*values), native(graph).function(*values)
    assert int(diagnostics[4]) == fp.Status.OK
    judgement = Judge(ocp)(np.asarray(other.full()), first, np.asarray(data.full()))
    assert judgement.residual <= 1e-6
    np.testing.assert_array_equal(diagnostics.full()[3:], other_diagnostics.full()[3:])
    np.testing.assert_allclose(one.full(), other.full(), atol=1e-6)


def test_a_horizon_that_cannot_be_kept_ends_with_the_least_violation():
    """The reactor begins above its limit and cannot cool at once: INFEASIBLE, and no plan violates the limit less in sum."""
    ocp, data, first = first_horizon("reactor")
    hot = first + np.array([0.0, 10.0, 0.0])
    plan = fp.solve(ocp, fp.FixedPoint(iterations=1, tolerance=tolerance_of(ocp)), hot, data)
    assert plan.status == fp.Status.INFEASIBLE
    beyond = np.maximum(plan.states[1, 1:] - 351.5, 0).sum()
    assert beyond > 1e-3
    assert "'T' is" in plan.violations()[0]
    coldest = np.asarray(ocp.dynamics(hot, 280.0, data[:, 0]).full()).ravel()
    assert plan.states[1, 1] == pytest.approx(coldest[1], abs=1e-6)
    assert plan.inputs[0, 0] == pytest.approx(280.0, abs=1e-6)


def test_scales_do_not_grow_with_the_horizon_of_an_unstable_plant():
    """C is the curvature with later inputs answering: for the pendulum it stays, where the open-loop one is 1e4 times as large."""
    ocp, _, _ = first_horizon("pendulum")
    assert scales(ocp).cost < 1e-3 * float(ocp.step * curvature_at_rest(ocp.along, ocp.step)[0]) * 15.0**2


@pytest.mark.parametrize("start", [3, 13])
def test_horizons_with_limits_of_inputs_only_are_rescued(start):
    """An unstable reactor, cold: the plain iteration ends at a hundred times the cost, the solve at IPOPT's."""
    case = FOREIGN["reactor"]()
    ocp = transcribe(case.plant, case.reference, case.horizon, case.cost, fp.Limits(inputs=case.limits.inputs))
    data = stage_data(case.plant, case.reference, case.horizon, case.cost)(0.0, case.plant.approximate)
    first, optimiser = case.first(ocp, first_states(case, 40, 3)[:, start]), fp.FixedPoint(1, tolerance_of(ocp))
    plain = optimiser.converging(ocp)(first, data, ocp.input_lower, ocp.input_upper, optimiser.memory(ocp).start())
    plan = fp.solve(ocp, optimiser, first, data)
    other = fp.solve(ocp, fp.Ipopt(accuracy=1e-9), first, data, calls=2)
    assert int(plain[1][4]) != fp.Status.OK
    assert float(plain[1][0]) > 100 * known(plan.cost)
    assert plan.status == fp.Status.OK
    assert known(plan.cost) <= known(other.cost) * (1 + 3e-5)
    assert Judge(ocp)(plan.inputs, first, np.asarray(data.full())).residual <= 1e-6


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
    run = fp.simulate(problem, fp.RecedingHorizon(fp.FixedPoint()), seed=0, compiled=False)
    return np.ravel(run["command.F"]) / force, np.ravel(run["status"])


@pytest.mark.parametrize("seed", slow_but(range(60), *range(8)))
def test_commands_do_not_depend_on_the_units(seed):
    """Random units of cost, force, length and time: what counts as kept and as solved is a share of the limits."""
    cost, force, length, time = 10.0 ** np.random.default_rng(seed).uniform([-6, -4, -6, -3], [6, 4, 6, 3])
    (command, status), (other, after) = _run_in_units(), _run_in_units(cost, force, length, time)
    np.testing.assert_allclose(other, command, atol=8e-6)
    np.testing.assert_array_equal(after, status)
