"""The horizon: adjoint gradient, costs and their mistakes, plans sooner than a stage, stages of several lengths, economic costs."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import horizon_of, rolled
from helpers.plants import chain, known, pendulum
from scipy.optimize import minimize

import fpirhc as fp
from fpirhc.conformance import posed
from fpirhc.contracts import reduced_gradient
from fpirhc.errors import InvalidProblem, NotSupported

PENDULUM_REFERENCE = fp.Trajectory(lambda t: {"angle": 0.5 * ca.sin(2 * t)})
COSTS = {
    "deviation": fp.Quadratic(states={"angle": 10.0, "angle'": 1.0}, deviation={"torque": 0.1}),
    "rate": fp.Quadratic(states={"angle": 10.0}, effort={"torque": 0.1}, rate={"torque": 0.3}),
    "terminal": fp.Quadratic(states={"angle": 1.0}, effort={"torque": 0.1}, terminal={"angle": 50.0}),
    "lqr": fp.Quadratic(states={"angle": 1.0}, effort={"torque": 0.1}, terminal=fp.LQRTerminal()),
    "general": fp.CustomCost(
        terms=lambda v: {
            "angle": ca.sqrt((v.state.angle - v.reference.angle) ** 2 + 1e-2),
            "torque": 0.1 * v.input.torque**4 + 0.01 * (v.input.torque - v.input_before.torque) ** 2,
        },
        terminal=lambda v: 5 * v.state.angle**2,
    ),
}


def built(cost, horizon=None, plant=None, limits=None):
    """(ocp, data) of a pendulum's horizon."""
    selection, steps = plant or pendulum(), horizon or fp.Horizon(stages=8, step=0.05)
    return horizon_of(selection, PENDULUM_REFERENCE, steps, cost, limits, time=0.2)


def point(ocp, seed=0):
    """A random first state and plan."""
    random = np.random.default_rng(seed)
    return random.normal(size=ocp.state.size), random.normal(size=(ocp.input.size, ocp.stages))


@pytest.mark.parametrize("name", COSTS)
@pytest.mark.parametrize("discretisation", [fp.RungeKutta4(), fp.Collocation()])
def test_adjoint_gradient_agrees_with_finite_differences(name, discretisation):
    """An independent check, by central differences of the rolled-out cost."""
    ocp, data = built(COSTS[name], fp.Horizon(stages=8, step=0.05, discretisation=discretisation))
    s0, inputs = point(ocp, 1)
    slope = reduced_gradient(ocp)(s0, inputs, data, np.zeros((ocp.state.size, ocp.stages)))[1].full()
    for k in (0, 3, ocp.stages - 1):
        direction = np.zeros_like(inputs)
        direction[0, k] = 1e-5
        high, low = (rolled(ocp, s0, inputs + sign * direction, data).cost for sign in (1, -1))
        assert slope[0, k] == pytest.approx((high - low) / 2e-5, rel=1e-5, abs=1e-7)


def test_rate_cost_counts_the_change_from_the_last_command():
    """The previous input is part of the stage's state; holding it costs nothing. Terms add up to the cost."""
    ocp, data = built(fp.Quadratic(states={"angle": 0.0}, rate={"torque": 2.0}))
    first = np.array([0.1, 0.0, 0.7])
    held = rolled(ocp, first, np.full((1, ocp.stages), 0.7), data)
    jump = rolled(ocp, first, np.full((1, ocp.stages), 1.7), data)
    assert held.cost == 0.0
    assert jump.cost == pytest.approx(2.0 * ocp.step)
    ocp, data = built(COSTS["rate"])
    run = rolled(ocp, *point(ocp), data)
    assert ocp.terms == ("states", "effort", "rate")
    assert run.cost == pytest.approx(run.terms.sum() + float(ocp.terminal_cost(run.states[:, -1], data[:, -1])))


def test_lqr_terminal_makes_a_short_horizon_endless():
    """On a linear plant at rest the planned first input is the infinite-horizon LQR input, however short the horizon."""
    plant, reference = chain(2), fp.Trajectory(lambda t: {"y": 0 * t})
    cost = fp.Quadratic(states={"y": 3.0, "y'": 0.5}, effort={"u": 0.2}, terminal=fp.LQRTerminal())
    horizon = fp.Horizon(stages=3, step=0.1)
    ocp, data = horizon_of(plant, reference, horizon, cost, fp.Limits())
    plan = fp.solve(ocp, fp.ReducedGradient(iterations=100, tolerance=1e-9), np.array([1.0, -0.3]), data)
    a, b = np.array([[1, 0.1], [0, 1]]), np.array([[0.005], [0.1]])
    import control  # takes a second, which every process would pay

    gain, _, _ = control.dlqr(a, b, np.diag([3.0, 0.5]), np.array([[0.2]]))
    assert plan.status == fp.Status.OK
    np.testing.assert_allclose(plan.inputs[:, 0], -np.asarray(gain) @ [1.0, -0.3], rtol=1e-6)


BAD_COSTS = {
    "state": (fp.Quadratic(states={"angel": 1.0}), "'angel' is unknown. Did you mean 'angle'"),
    "zero": (fp.Quadratic(states={"angle": 0.0}), "every weight is zero"),
    "term": (fp.CustomCost(terms=lambda v: {"log": ca.log(v.state.angle)}), "term 'log' is -inf"),
    "end": (
        fp.CustomCost(lambda v: {"a": v.input.torque**2}, terminal=lambda v: v.input.torque),
        "end .* has no input",
    ),
    "lqr": (fp.Quadratic(states={"angle": 1.0}, terminal=fp.LQRTerminal()), "needs a positive effort"),
    # Two of one name were one, and a cost or a limit was lost.
    "twice": (fp.CustomCost(lambda v: {"held": v.state.angle**2 + v.input.torque**2}), "term 'held' has the name of"),
    "many": (fp.Quadratic(states={"angel": 1.0, "angle": 1.0}, effort={"torqe": 1.0}), "2 mistakes"),
}


@pytest.mark.parametrize("case", BAD_COSTS)
def test_mistakes_of_a_cost(case):
    cost, message = BAD_COSTS[case]
    horizon = fp.Horizon(stages=3, step=0.1, blocks=(1, 2))
    with pytest.raises(InvalidProblem, match=message):
        horizon_of(pendulum(), fp.Trajectory(lambda t: {"angle": 0 * t}), horizon, cost)


def test_curvature_is_the_bend_of_the_cost_along_the_first_input():
    """On a linear plant it is the second derivative of V, and it scales with the weights."""
    plant, reference = chain(2), fp.Trajectory(lambda t: {"y": ca.sin(t)})
    horizon = fp.Horizon(stages=6, step=0.1)
    for factor in (1.0, 1e-7):
        cost = fp.Quadratic(
            states={"y": 3.0 * factor}, effort={"u": 0.2 * factor}, rate={"u": factor}, terminal={"y'": 5.0 * factor}
        )
        ocp, data = horizon_of(plant, reference, horizon, cost, fp.Limits())
        s0, inputs = point(ocp)
        value = [rolled(ocp, s0, inputs + k * np.eye(1, 6), data).cost for k in (-1, 0, 1)]
        assert ocp.curvature[0] == pytest.approx((value[0] - 2 * value[1] + value[2]) / ocp.step, rel=1e-6)


# Plans that follow one another sooner than a stage, and stages of several lengths
STAGES, STEP, PERIOD = 6, 0.08, 0.02
WEIGHTS = {"angle": 40.0, "angle'": 1.0}
EFFORT, RATE, FASTEST = 1e-3, 0.05, 12.0
GROWING = (1.0, 1.0, 1.5, 2.0, 3.0, 4.0)
CONVERGED = fp.FixedPointSolver(iterations=30, tolerance=1e-9)


def swing(t):
    return {"angle": 0.6 * ca.sin(1.5 * t)}


def task(replan="cycle", *, mass=1.0, believed=1.4, **changed):
    values: dict[str, Any] = {
        "plant": pendulum(mass, believed),
        "reference": fp.Trajectory(swing),
        "start": {"angle": 0.3},
        "period": PERIOD,
        "duration": 0.6,
        "limits": fp.Limits(inputs={"torque": (-6.0, 6.0)}),
        "horizon": fp.Horizon(stages=STAGES, step=STEP, replan=replan),
        "cost": fp.Quadratic(states=WEIGHTS, effort={"torque": EFFORT}),
    }
    return fp.Problem(**values | changed)


def planning(optimiser=CONVERGED, deformation=None):
    return fp.RecedingHorizon(optimiser, deformation or fp.Identity())


def own_plan(problem, time, state, before, *, rate=0.0, fastest=np.inf, between=PERIOD, lengths=(1.0,) * STAGES):
    """First input of the horizon that begins at this time, by a program of its own and IPOPT."""
    p, rate_of = problem.plant.approximate, problem.plant.equations.rate
    opti = ca.Opti()
    u: Any = opti.variable(STAGES)
    x: Any = ca.DM(state)
    cost: Any = 0
    last: Any = before
    taken = between
    t = time
    for i in range(STAGES):
        h = STEP * lengths[i]
        cost += h * (WEIGHTS["angle"] * (x[0] - 0.6 * np.sin(1.5 * t)) ** 2 + EFFORT * u[i] ** 2)
        cost += h * WEIGHTS["angle'"] * (x[1] - 0.9 * np.cos(1.5 * t)) ** 2
        cost += rate * STEP**2 * ((u[i] - last) / taken) ** 2 * taken
        if np.isfinite(fastest):
            opti.subject_to(opti.bounded(-fastest * taken, u[i] - last, fastest * taken))
        k1 = rate_of(x, u[i], p)
        k2 = rate_of(x + h / 2 * k1, u[i], p)
        k3 = rate_of(x + h / 2 * k2, u[i], p)
        k4 = rate_of(x + h * k3, u[i], p)
        x, last, taken, t = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), u[i], h, t + h
    cost += h * WEIGHTS["angle"] * (x[0] - 0.6 * np.sin(1.5 * t)) ** 2
    cost += h * WEIGHTS["angle'"] * (x[1] - 0.9 * np.cos(1.5 * t)) ** 2
    opti.minimize(cost)
    opti.subject_to(opti.bounded(-6.0, u, 6.0))
    opti.solver("ipopt", {"print_time": 0}, {"print_level": 0, "sb": "yes", "tol": 1e-11})
    return float(np.ravel(opti.solve().value(u))[0])


@pytest.mark.parametrize(
    ("replan", "lengths", "rate", "fastest"),
    [  # every two of the settings meet
        pytest.param("stage", (), 0.0, np.inf, marks=pytest.mark.slow),
        ("stage", GROWING, RATE, np.inf),
        pytest.param("stage", (), 0.0, FASTEST, marks=pytest.mark.slow),
        pytest.param("cycle", GROWING, 0.0, np.inf, marks=pytest.mark.slow),
        pytest.param("cycle", (), RATE, np.inf, marks=pytest.mark.slow),
        ("cycle", GROWING, 0.0, FASTEST),
        pytest.param(3, (), 0.0, np.inf, marks=pytest.mark.slow),
        (3, GROWING, RATE, np.inf),
        (3, (), 0.0, FASTEST),
    ],
)
def test_every_plan_is_that_of_an_independent_program_at_its_own_time(replan, rate, fastest, lengths):
    limits = fp.Limits(
        inputs={"torque": (-6.0, 6.0)}, rates={"torque": (-FASTEST, FASTEST)} if np.isfinite(fastest) else {}
    )
    cost = fp.Quadratic(states=WEIGHTS, effort={"torque": EFFORT}, rate={"torque": rate} if rate else {})
    problem = task(replan, limits=limits, cost=cost)
    problem = replace(problem, horizon=replace(problem.horizon, lengths=lengths))
    run = fp.simulate(problem, planning(), seed=0, compiled=None)
    every = {"stage": 4, "cycle": 1, 3: 3}[replan]
    command, planned, states = run["command"][:, 0], run["planned"][:, 0], run["state"]
    for k in range(every, run.cycles, 2 * every):
        settings = {"rate": rate, "fastest": fastest, "between": every * PERIOD, "lengths": lengths or (1.0,) * STAGES}
        expected = own_plan(problem, run.time[k], states[k], command[k - 1], **settings)
        assert planned[k] == pytest.approx(expected, abs=2e-4)
    changes = np.flatnonzero(np.abs(np.diff(planned)) > 1e-9) + 1
    assert (changes % every == 0).all()
    assert np.abs(np.diff(command)).max() <= (1 + 1e-9) * fastest * PERIOD  # what a plan wants at once takes its cycles


def test_a_plan_at_a_boundary_of_stages_is_that_of_a_plan_per_stage():
    """Plans that are solved do not depend on how they were warm started: the same state and time give the same plan."""
    each, per_stage = (planning(fp.FixedPointSolver(iterations=30, tolerance=1e-10)) for _ in range(2))
    one = fp.simulate(task("stage"), per_stage, seed=0, compiled=None)
    later = fp.simulate(task("cycle"), each, seed=0, compiled=None)
    assert later["command"][0] == pytest.approx(one["command"][0], abs=1e-9)
    again = fp.simulate(task(4), each, seed=0, compiled=None)
    np.testing.assert_array_equal(again["command"], one["command"])


OPTIMISERS = {
    "fixed point": fp.FixedPointSolver(iterations=3, tolerance=1e-6),
    "gradient": fp.GradientFixedPoint(iterations=400, tolerance=1e-4),
    "full space": fp.FullSpaceFixedPoint(iterations=4000, tolerance=1e-3),
    "reduced gradient": fp.ReducedGradient(iterations=60, tolerance=1e-5),
    "interior point": fp.Ipopt(tolerance=1e-6),
}


@pytest.mark.parametrize("replan", ["cycle", "stage"])
@pytest.mark.parametrize("name", OPTIMISERS)
def test_a_warm_start_is_what_the_plan_foresees_on_the_next_stages(name, replan):
    """The mean of the plan over every stage of the next horizon, by quadrature on a fine grid; the last stage goes on."""
    horizon = fp.Horizon(STAGES, STEP, replan=replan, lengths=GROWING)
    problem, optimiser = task(horizon=horizon), OPTIMISERS[name]
    ocp = posed(planning(optimiser).planner.planned(problem))[0]
    layout, inputs = optimiser.memory(ocp), np.random.default_rng(0).standard_normal(STAGES)
    memory = layout.start()
    memory[layout.slice("plan_inputs")] = inputs
    column = ca.MX.sym("memory", layout.size)
    moved = ca.Function("moved", [column], [optimiser.shifted(ocp, column)])(memory).full().ravel()
    nodes, later = horizon.nodes, {"cycle": PERIOD, "stage": STEP}[replan]
    fine = (np.arange(2000) + 0.5) / 2000
    times = nodes[:-1, None] + later + fine * np.diff(nodes)[:, None]
    place = np.minimum(np.searchsorted(nodes, times, side="right") - 1, STAGES - 1)
    np.testing.assert_allclose(moved[layout.slice("plan_inputs")], inputs[place].mean(axis=1), atol=2e-3)


def pond(lengths):
    """x+ = x + 0.3 (u - x |x|) from 0.2 along 1 + 0.4 sin(0.5 t), with steps of 1."""
    plant = fp.Plant.discrete(
        states={"x": "m"},
        inputs={"u": "m/s"},
        parameters={"a": fp.Parameter(0.3, 0.3, "1")},
        next=lambda x, u, p: {"x": x.x + p.a * (u.u - x.x * ca.fabs(x.x))},
        step=1.0,
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"x": 1 + 0.4 * ca.sin(0.5 * t)}),
        start={"x": 0.2},
        period=1.0,
        duration=6.0,
        limits=fp.Limits(inputs={"u": (-3.0, 3.0)}),
        horizon=fp.Horizon(len(lengths), 1.0, lengths=lengths),
        cost=fp.Quadratic(states={"x": 2.0}, effort={"u": 0.1}),
    )


@pytest.mark.parametrize("optimiser", [fp.FixedPointSolver(iterations=200, tolerance=1e-10), fp.Ipopt(tolerance=1e-9)])
def test_long_stages_of_a_map_hold_the_input_over_whole_steps(optimiser):
    """The first plan is the minimum of the cost over whole steps, by a general optimiser on plain arithmetic."""
    lengths = (1.0, 2.0, 1.0, 3.0)
    problem = pond(lengths)
    run = fp.simulate(problem, planning(optimiser), seed=0, compiled=False)

    def cost(inputs):
        x, t, value = 0.2, 0.0, 0.0
        for u, length in zip(inputs, lengths, strict=True):
            value += length * (2.0 * (x - 1 - 0.4 * np.sin(0.5 * t)) ** 2 + 0.1 * u**2)
            for _ in range(int(length)):
                x += 0.3 * (u - x * abs(x))
            t += length
        return value + lengths[-1] * 2.0 * (x - 1 - 0.4 * np.sin(0.5 * t)) ** 2

    best = minimize(cost, np.ones(4), bounds=[(-3.0, 3.0)] * 4, options={"ftol": 1e-15, "gtol": 1e-10})
    assert run["command"][0, 0] == pytest.approx(best.x[0], abs=1e-4)


def test_a_run_has_its_cost_whatever_the_stages_are():
    """It is the stage cost over every cycle at the states that were reached, whose rate no length of a stage changes."""
    horizons = fp.Horizon(STAGES, STEP, replan="cycle", lengths=GROWING), fp.Horizon(STAGES, STEP)
    for horizon in horizons:
        run = fp.simulate(task(horizon=horizon), planning(), seed=0, compiled=None)
        angle, rate = run["state"].T
        q, v = 0.6 * np.sin(1.5 * run.time), 0.9 * np.cos(1.5 * run.time)
        expected = WEIGHTS["angle"] * (angle - q) ** 2 + WEIGHTS["angle'"] * (rate - v) ** 2
        expected += EFFORT * run["command"][:, 0] ** 2
        priced = replace(task(horizon=horizon), measure_from=0.0)
        assert fp.measure(priced, run)["cost"]["total"] / PERIOD == pytest.approx(expected.sum(), rel=1e-9)


# Economic costs, which do not bend upwards: the exact Hessian with interior steps finds the optimum. The reactor of M. Diehl,
# R. Amrit, J. B. Rawlings, A Lyapunov function for economic optimizing model predictive control, IEEE Trans. Automatic Control
# 56(3), 2011, example V-B: A -> B of first order in a stirred tank, dilution Q from 0 to 20 l/min, the cost -2 Q c_B + Q / 2. The
# best steady state is c_A = c_B = 1/2 mol/l at Q = 12 l/min; their regularisation is .505 times the squared distance from it, which
# makes it optimal for the dynamic problem too.
REACTOR = fp.Plant(
    {"cA": "mol/l", "cB": "mol/l"},
    {"Q": "l/min"},
    {"k": fp.Parameter(1.2, 1.2, "1/min"), "V": fp.Parameter(10.0, 10.0, "l"), "feed": fp.Parameter(1.0, 1.0, "mol/l")},
    lambda q, u, p: {"cA": u.Q / p.V * (p.feed - q.cA) - p.k * q.cA, "cB": -u.Q / p.V * q.cB + p.k * q.cA},
    order=1,
    controlled=("cB",),
    time_unit="min",
)
STEADY = fp.Trajectory(lambda t: {"cA": 0.5 + 0 * t, "cB": 0.5 + 0 * t})
STARTS = ([0.4, 0.2], [0.1, 0.8])
TOLERANCE = 1e-6
HALF = {"cA": 0.5, "cB": 0.4}
ECONOMIC = fp.FixedPointSolver(iterations=1, tolerance=TOLERANCE, hessian=fp.ExactHessian())


def economic(regular: float, states: dict[str, tuple[float, float]], stages: int = 30):
    """The horizon in standard form, and its data."""
    cost = fp.CustomCost(
        lambda v: {
            "production": -v.input.Q * (2 * v.state.cB - 0.5),
            "regular": regular * ((v.state.cA - 0.5) ** 2 + (v.state.cB - 0.5) ** 2 + (v.input.Q - 12) ** 2),
        }
    )
    made = fp.Horizon(stages=stages, step=0.1)
    return horizon_of(REACTOR, STEADY, made, cost, fp.Limits(inputs={"Q": (0.0, 20.0)}, states=states), start=HALF)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("regular", [0.505, 0.05])
@pytest.mark.parametrize("states", [{}, {"cA": (0.0, 0.49), "cB": (0.0, 1.0)}], ids=["inputs", "states"])
def test_a_production_rate_has_the_optimum_of_ipopt(regular, states, start):
    """The published regularisation, and a tenth of it: one optimum, found by both; the limit of c_A is active."""
    ocp, data = economic(regular, states)
    assert ocp.along.least_curvature() < -0.1
    plan = fp.solve(ocp, ECONOMIC, np.array(start), data)
    best = fp.solve(ocp, fp.Ipopt(accuracy=1e-9), np.array(start), data)
    assert plan.status == best.status == fp.Status.OK
    assert known(plan.cost) == pytest.approx(known(best.cost), rel=1e-6)
    np.testing.assert_allclose(plan.inputs, best.inputs, atol=1e-4)
    if states:
        assert plan.states[0].max() == pytest.approx(0.49, abs=1e-6)


def test_a_long_horizon_passes_the_published_steady_state():
    """A plan of ten minutes is at the steady state in between: c_A = c_B = 1/2 mol/l at 12 l/min."""
    ocp, data = economic(0.505, {}, stages=100)
    first = np.asarray(ocp.start([0.4, 0.2], [0.0]).full()).ravel()
    plan = fp.solve(ocp, ECONOMIC, first, data)
    assert plan.status == fp.Status.OK
    np.testing.assert_allclose(plan.states[:2, 45:61], 0.5, atol=4e-3)
    np.testing.assert_allclose(plan.inputs[0, 45:58], 12.0, atol=5e-2)


def test_gauss_newton_refuses_an_economic_cost_and_names_the_remedy():
    ocp, data = economic(0.505, {})
    with pytest.raises(NotSupported, match=r"bends upwards.*hessian=ExactHessian\(\)"):
        fp.solve(ocp, fp.FixedPointSolver(1, TOLERANCE), np.array(STARTS[0]), data)
