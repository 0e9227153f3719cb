"""Limits of states, rates and paths, with blocks and margins: the plans of independent solvers, and names in every complaint."""

import math
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import HORIZON, horizon_of, pendulum_problem, rolled
from helpers.plants import chain, known
from scipy.optimize import minimize

import fpirhc as fp
from fpirhc.conformance import posed
from fpirhc.contracts import judge
from fpirhc.errors import FpirhcError, NotSupported

FIRST = np.array([0.6, 0.0])
FIXED = fp.FixedPointSolver(iterations=1, tolerance=1e-7)
IPOPT = fp.Ipopt(tolerance=1e-4, accuracy=1e-11)


def limited(limits):
    ocp, data = pendulum_problem(limits=limits)
    return ocp, data, ocp.start(FIRST, [0.0]).full().ravel()


def speed_and_angle(view):
    return view.state["angle'"] + 2 * view.state.angle


CASES = {
    "state": fp.Limits(states={"angle'": (-0.2, 0.3)}),
    "state and input": fp.Limits(inputs={"torque": (-4.0, 4.0)}, states={"angle'": (-0.2, 0.5)}),
    "rate": fp.Limits(rates={"torque": (-10.0, 10.0)}),
    "path": fp.Limits(paths={"mix": fp.PathConstraint(speed_and_angle, lower=1.0)}),
    "input path": fp.Limits(
        paths={"power": fp.PathConstraint(lambda v: v.input.torque * v.state["angle'"], upper=0.5)}
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_limits_are_kept_at_the_same_optimum_as_ipopt(case):
    """The limit is active, the plan is inside, and cost and inputs are those of an interior-point method."""
    limits = CASES[case]
    ocp, data, first = limited(limits)
    free, free_data, free_first = limited(fp.Limits(inputs=limits.inputs))
    plan, other = fp.solve(ocp, FIXED, first, data), fp.solve(ocp, IPOPT, first, data)
    unlimited = fp.solve(free, FIXED, free_first, free_data)
    assert plan.status == fp.Status.OK
    assert other.status == fp.Status.OK
    assert known(plan.feasibility) <= 1e-8
    assert plan.cost == pytest.approx(other.cost, rel=1e-6)
    assert known(plan.cost) > known(unlimited.cost) * (1 + 1e-6), "the limit must cost something, or it is not active"
    np.testing.assert_allclose(plan.inputs, other.inputs, atol=2e-5)
    assert plan.verify()[1] <= 1e-6
    assert plan.violations() == ()


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (fp.Limits(rates={"torqe": (-1.0, 1.0)}), "torque"),
        (fp.Limits(rates={"torque": (1.0, -1.0)}), "swap them"),
        (fp.Limits(paths={"angle": fp.PathConstraint(lambda v: v.state.angle)}), "already the name"),
        (fp.Limits(paths={"mix": fp.PathConstraint(lambda v: v.state.angel, upper=1.0)}), "angle"),
        (fp.Limits(paths={"mix": fp.PathConstraint(lambda v: v.state.vector, upper=1.0)}), "one scalar"),
        (fp.Limits(prices={"angle": 1.0}), "prices: limit of"),
        (
            fp.Limits(rates={"torque": (-1.0, 1.0)}, paths={"torque rate": fp.PathConstraint(speed_and_angle)}),
            "'torque rate' is already the name of the limit in rates",
        ),
        (fp.Limits(paths={"root": fp.PathConstraint(lambda v: ca.sqrt(v.state.angle - 9))}), "'root' is nan .*stage 0"),
        (
            fp.Limits(paths={"off": fp.PathConstraint(lambda v: vars(v)["feedforward"].torque)}),
            "'off' is nan .*feedforward only .*deviation",
        ),
    ],
)
def test_mistakes_are_named(limits, message):
    with pytest.raises(FpirhcError, match=message):
        limited(limits)


def priced(price):
    ocp, data, first = limited(fp.Limits(states={"angle'": (-0.5, 0.5)}, prices={"angle'": price}))
    return ocp, FIXED, first, data


def test_priced_limits_are_kept_exactly_below_their_price_and_given_up_beyond():
    """A price above every multiplier gives the plan of the hard limit; below, the limit is violated, at that price."""
    ocp, data, first = limited(fp.Limits(states={"angle'": (-0.5, 0.5)}))
    strict = fp.solve(ocp, FIXED, first, data)
    largest = np.abs(strict.state_multipliers).max() / ocp.step
    plan_inside = fp.solve(*priced(1.1 * largest))
    assert plan_inside.status == fp.Status.OK
    np.testing.assert_allclose(plan_inside.inputs, strict.inputs, atol=1e-6)
    assert plan_inside.slacks() == {"angle'": pytest.approx(0.0, abs=1e-6)}
    given_up = fp.solve(*priced(0.3 * largest))
    assert given_up.status == fp.Status.OK
    assert given_up.states[1, 1:].min() < -0.51
    assert given_up.slacks()["angle'"] > 0
    assert given_up.feasibility == 0
    assert known(given_up.cost) + given_up.slacks()["angle'"] < known(strict.cost)
    assert np.abs(given_up.state_multipliers).max() == pytest.approx(0.3 * largest * ocp.step, rel=1e-3)


def test_priced_limits_have_the_optimum_of_a_problem_with_slacks():
    """SLSQP of scipy on the inputs and one slack per node finds the same sum of cost and prices."""
    ocp, _, first, data = priced(3.0)
    plan, n = fp.solve(ocp, FIXED, first, data), ocp.stages

    def room(v):
        speeds = rolled(ocp, first, v[None, :n], data).states[1, 1:]
        return np.concatenate([speeds + 0.5 + v[n:], 0.5 + v[n:] - speeds, v[n:]])

    total = minimize(
        lambda v: rolled(ocp, first, v[None, :n], data).cost + 3.0 * ocp.step * v[n:].sum(),
        np.concatenate([plan.inputs[0] + 0.1, np.ones(n)]),
        method="SLSQP",
        constraints={"type": "ineq", "fun": room},
        options={"ftol": 1e-12, "maxiter": 500},
    )
    assert known(plan.cost) + plan.slacks()["angle'"] == pytest.approx(total.fun, rel=1e-5)


def test_prices_are_refused_by_who_cannot_take_them():
    """A solver that keeps limits must not turn a priced one into a hard one."""
    ocp, _, first, data = priced(1.0)
    with pytest.raises(NotSupported, match="takes no prices"):
        fp.solve(ocp, IPOPT, first, data)


# Inputs that are held over blocks
SPEED = fp.Limits(inputs={"torque": (-20.0, 20.0)}, states={"angle'": (-0.4, 1.5)})
BLOCKS = (1, 1, 2, 4, 4)


@pytest.mark.parametrize("limits", [fp.Limits(inputs=SPEED.inputs), SPEED], ids=["inputs", "states"])
def test_inputs_are_held_over_blocks_at_the_best_values(limits):
    """The plan is constant in every block, and is the best such plan of the horizon without blocks, found by scipy."""
    ocp, data = pendulum_problem(limits=limits, horizon=replace(HORIZON, blocks=BLOCKS))
    first = ocp.start([0.4, 0.0], [0.0]).full().ravel()
    plan = fp.solve(ocp, FIXED, first, data)
    assert plan.status == fp.Status.OK
    assert max(np.ptp(part) for part in np.split(plan.inputs[0], np.cumsum(BLOCKS)[:-1])) < 1e-6
    free, free_data = pendulum_problem(limits=limits)

    def held(values):
        return rolled(free, [0.4, 0.0], np.repeat(values, BLOCKS)[None], free_data)

    def inside(values):
        speeds, low, high = held(values).states[1, 1:], free.state_lower[1], free.state_upper[1]
        return np.concatenate([speeds - low, high - speeds]) if np.isfinite(high) else np.ones(1)

    settings = {"constraints": {"type": "ineq", "fun": inside}, "options": {"ftol": 1e-13, "maxiter": 300}}
    best = minimize(lambda values: held(values).cost, np.zeros(5), method="SLSQP", **settings)
    assert plan.cost == pytest.approx(best.fun, rel=1e-6)
    without = fp.solve(free, FIXED, np.array([0.4, 0.0]), free_data)
    assert known(plan.cost) > known(without.cost)


# What cannot be kept is named: a double integrator |u| <= 1 m/s2, whose best braking is known by hand


def plan_of(start: tuple[float, float], states: dict[str, tuple[float, float]], stages: int, **more: Any) -> fp.Plan:
    """The plan from (y, y') towards y = 0."""
    reference, horizon = fp.Trajectory(lambda t: {"y": 0 * t}), fp.Horizon(stages=stages, step=0.1)
    cost = fp.Quadratic(states={"y": 1.0, "y'": 0.1}, effort={"u": 0.01})
    limits = fp.Limits(inputs={"u": (-1.0, 1.0)}, states=states, **more)
    ocp, data = horizon_of(chain(2), reference, horizon, cost, limits)
    first = np.asarray(ocp.start(list(start), [0.0]).full()).ravel()
    return fp.solve(ocp, FIXED, first, data)


OUT_OF_REACH = {  # first state, limits of y, stages, the limit, the largest violation in m
    "too fast to stop": ((0.9, 1.0), (-5.0, 1.0), 25, "above 1", 0.4),  # full braking stops at 1.4 m after 1 s
    "outside at rest": ((1.3, 0.0), (-5.0, 1.0), 25, "above 1", 0.295),  # after one stage of full braking
    "a far limit": ((0.0, 0.0), (3.0, 4.0), 5, "below 3", 2.995),
}


@pytest.mark.parametrize(("start", "limits", "stages", "limit", "most"), OUT_OF_REACH.values(), ids=OUT_OF_REACH)
def test_what_cannot_be_kept_is_named_by_how_much(start, limits, stages, limit, most):
    """Full braking, known by hand, is the plan of least violation, which four more calls do not lower; the worst stage is named."""
    plan = plan_of(start, {"y": limits}, stages)
    assert (plan.status, plan.calls) == (fp.Status.INFEASIBLE, 5)
    violations = plan.violations()
    assert limit in " ".join(violations)
    values = [float(text.partition(" is ")[2].split()[0]) for text in violations if "at stage 0" not in text]
    bound = next(v for v in limits if f" {v:g}" in limit)
    assert max(abs(value - bound) for value in values) == pytest.approx(most, abs=1e-3) == plan.verify()[2]
    assert "soften state limits, or lengthen the horizon" in plan.status.remedy


def test_a_price_lets_the_plan_pass_and_come_back():
    plan = plan_of((0.9, 1.0), {"y": (-5.0, 1.0)}, 25, prices={"y": 1e2})
    assert plan.status == fp.Status.OK
    assert plan.violations() == ()
    assert plan.states[0, 10] == pytest.approx(1.4, abs=1e-3)
    assert plan.states[0, 20:].max() < 1.0 + 1e-3


# Plants that run away by themselves


def upright(length, horizon, limits):
    """An upright pendulum, which falls with the rate sqrt(g / length)."""
    plant = fp.Plant(
        coordinates={"a": "rad"},
        inputs={"M": "N m"},
        parameters={"g": fp.Parameter(9.81, 9.81, "m/s^2")},
        response=lambda q, v, u, p: {"a": p.g / length * ca.sin(q.a) + u.M / length**2 - 0.05 * v.a},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"a": 0 * t}),
        start={"a": 0.2},
        period=0.02,
        duration=0.6,
        limits=fp.Limits(inputs={"M": (-20.0, 20.0)}, states=limits),
        horizon=fp.Horizon(stages=round(horizon / 0.04), step=0.04),
        cost=fp.Quadratic(states={"a": 10.0, "a'": 1.0}, effort={"M": 0.01}),
    )


PLANNED = fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-4))


@pytest.mark.parametrize(("horizon", "limits"), [(1.6, {}), (3.0, {}), (4.0, {}), (4.0, {"a": (-0.5, 0.5)})])
def test_a_plant_that_runs_away_itself_is_planned(horizon, limits):
    """It multiplies a motion by 1e10 over the horizon: every plan, the first one too, is that of IPOPT and OK.

    A plan that lets the pendulum fall does not look stationary.
    """
    problem = upright(0.25, horizon, limits)
    ocp, first, data = posed(problem)
    for tolerance in (1e-4, 1e-8):
        plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=tolerance), first, data)
        best = fp.solve(ocp, fp.Ipopt(tolerance=1e-8), first, data)
        assert plan.status is best.status is fp.Status.OK
        deeper = bool(limits) and known(plan.cost) < known(
            best.cost
        )  # between limits IPOPT ends in another valley at first
        assert deeper or plan.cost == pytest.approx(best.cost, rel=1e-6)
    judged = judge(ocp)(np.zeros((1, ocp.stages)), first, data, -20.0, 20.0, np.zeros((2, ocp.stages)))
    assert float(judged[1]) > 1.0  # N m, of the plan without torque
    run = fp.simulate(problem, PLANNED, seed=0, compiled=bool(limits))
    other = fp.simulate(problem, fp.RecedingHorizon(fp.Ipopt(tolerance=1e-8)), seed=0, compiled=False)
    assert set(fp.measure(problem, run).statuses) == {"OK"}
    np.testing.assert_allclose(run["state"], other["state"], atol=1e-4)


# Limits of a map hold at every step of a stage: one of a whole period hides an oscillator's swing from the nodes
STEPS, MOST = 8, 0.5
SHORT = 1.0 / STEPS
W = 2 * math.pi


def swung(x, u, p):
    faster = x.v + SHORT * (u.push - W**2 * x.a)
    return {"a": x.a + SHORT * faster, "v": faster}


SWUNG = fp.Plant.discrete(
    states={"a": "m", "v": "m/s"},
    inputs={"push": "m/s^2"},
    next=swung,
    step=SHORT,
    outputs={"a": fp.Output("m", lambda x, p: x.a)},
    parameters={"unused": fp.Parameter(1.0, 1.0, "1")},
)
STILL = fp.Trajectory(lambda t: {"a": 0 * t})
PUSHED = fp.CustomCost(lambda v: {"push": (v.input.push - 30) ** 2})
LIMITED = {
    "state": fp.Limits(states={"a": (-1.0, MOST)}),
    "path": fp.Limits(paths={"swing": fp.PathConstraint(lambda v: v.state.a, upper=MOST, unit="m")}),
    "output": fp.Limits(paths={"swing": fp.PathConstraint(lambda v: v.output.a, upper=MOST, unit="m")}),
    "priced": fp.Limits(states={"a": (-1.0, MOST)}, prices={"a": 1e6}),
}


def largest(limits: fp.Limits, lengths: tuple[float, ...] = ()) -> float:
    """Largest swing over all single steps of a plan of three stages."""
    horizon = fp.Horizon(stages=3, step=STEPS * SHORT, lengths=lengths)
    ocp, data = horizon_of(SWUNG, STILL, horizon, PUSHED, limits)
    first = np.asarray(ocp.start([0.0, 0.0], [0.0]).full()).ravel()
    own = fp.FixedPointSolver(iterations=30, tolerance=1e-6, hessian=fp.ExactHessian())
    plan = fp.solve(ocp, own if limits.prices else fp.Ipopt(accuracy=1e-9), first, data)
    assert plan.status == fp.Status.OK
    a, v, seen = 0.0, 0.0, [0.0]
    for push, length in zip(plan.inputs[0], lengths or (1,) * 3, strict=True):
        for _ in range(round(STEPS * length)):
            v += SHORT * (push - W**2 * a)
            a += SHORT * v
            seen.append(a)
    return max(seen)


@pytest.mark.parametrize("name", ["state", "path", "output"])
@pytest.mark.parametrize("lengths", [(), (1.0, 2.0, 1.0)], ids=["equal", "longer"])
def test_hard_limits_hold_at_every_step_and_priced_ones_at_the_nodes_alone(name, lengths):
    """The limit is met exactly, so it is the one that binds the plan."""
    assert largest(LIMITED[name], lengths) == pytest.approx(MOST, abs=1e-6)
    assert largest(LIMITED["priced"]) > 1.5 * MOST


@pytest.mark.parametrize("side", [-1, 1])
def test_a_margin_narrows_the_plan_by_its_number_at_every_stage(side):
    """On the bound less the margin where the limit is active, like IPOPT's plan with the same margin."""
    ocp, data = pendulum_problem(limits=CASES["state and input"], horizon=replace(HORIZON, margins={"angle'": 0.13}))
    first = ocp.start(side * FIRST, [0.0]).full().ravel()
    plan, other = fp.solve(ocp, FIXED, first, data), fp.solve(ocp, fp.Ipopt(tolerance=1e-9), first, data)
    assert plan.status == fp.Status.OK
    room = (0.2 if side > 0 else 0.5) - 0.13 + side * plan.states[1, 1:]
    assert room.min() == pytest.approx(0.0, abs=1e-5)
    assert plan.cost == pytest.approx(other.cost, rel=1e-4)


@pytest.mark.parametrize("weights", [{"rate": {"F": 1.0}}, {}])
def test_the_rate_of_a_plan_counts_from_the_command_without_its_shift(weights):
    """A constant force that the model lacks: with the shift in its rate, a plan would pay for it for ever and stay off."""
    plant = fp.Plant(
        {"q": "m"}, {"F": "N"}, {"d": fp.Parameter(0.0, 2.0, "N")}, lambda q, u, p: {"q": u.F - q.q + p.d}, order=1
    )
    still, horizon = fp.Trajectory(lambda t: {"q": 0 * t}), fp.Horizon(stages=20, step=0.05)
    more = {"horizon": horizon, "cost": fp.Quadratic(states={"q": 10.0}, **weights), "duration": 6.0}
    problem = fp.Problem(plant, still, {"q": 0.0}, period=0.01, **more)
    plan = fp.RecedingHorizon(fp.FixedPointSolver(iterations=50, tolerance=1e-9), fp.Affine(-1.0))
    run = fp.simulate(problem, plan, seed=0)
    assert np.abs(run["state"][-50:, 0]).max() < 1e-6
