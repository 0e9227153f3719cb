"""Plans that follow one another sooner than a stage, and stages of several lengths: `Horizon(replan=..., lengths=...)`."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import pendulum
from scipy.optimize import minimize

import fpirhc as fp
from fpirhc.conformance import posed

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
