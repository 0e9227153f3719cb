"""Limits of states, rates, paths and the horizon's end: the same plans as an independent solver, and names in every complaint."""

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import horizon_of, rolled
from helpers.plants import known, pendulum

import fpirhc as fp
from fpirhc.errors import FpirhcError, NotSupported

PLANT, REFERENCE = pendulum(), fp.Trajectory(lambda t: {"angle": ca.sin(2 * t)})
COST = fp.Quadratic(states={"angle": 10.0, "angle'": 0.1}, effort={"torque": 0.05})
FIRST = np.array([0.6, 0.0])
FIXED = fp.FixedPointSolver(iterations=1, tolerance=1e-7)
IPOPT = fp.Ipopt(tolerance=1e-4, accuracy=1e-11)


def limited(limits, cost=COST, stages=12):
    horizon = fp.Horizon(stages=stages, step=0.05)
    ocp, data = horizon_of(PLANT, REFERENCE, horizon, cost, limits)
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
    from scipy.optimize import minimize

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
