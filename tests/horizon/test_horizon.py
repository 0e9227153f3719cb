"""The horizon: auxiliary function, adjoint gradient, costs and their mistakes."""

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import horizon_of, rolled
from helpers.plants import chain, pendulum

import fpirhc as fp
from fpirhc.contracts import reduced_gradient
from fpirhc.errors import InvalidProblem

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


def test_terms_add_up_to_the_cost():
    ocp, data = built(COSTS["rate"])
    s0, inputs = point(ocp)
    run = rolled(ocp, s0, inputs, data)
    final = float(ocp.terminal_cost(run.states[:, -1], data[:, -1]))
    assert ocp.terms == ("states", "effort", "rate")
    assert run.cost == pytest.approx(run.terms.sum() + final)


def test_rate_cost_counts_the_change_from_the_last_command():
    """The previous input is part of the stage's state; holding it costs nothing."""
    ocp, data = built(fp.Quadratic(states={"angle": 0.0}, rate={"torque": 2.0}))
    first = np.array([0.1, 0.0, 0.7])
    held = rolled(ocp, first, np.full((1, ocp.stages), 0.7), data)
    jump = rolled(ocp, first, np.full((1, ocp.stages), 1.7), data)
    assert held.cost == 0.0
    assert jump.cost == pytest.approx(2.0 * ocp.step)


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
    "many": (fp.Quadratic(states={"angel": 1.0, "angle": 1.0}, effort={"torqe": 1.0}), "2 mistakes"),
}


@pytest.mark.parametrize("case", BAD_COSTS)
def test_mistakes_of_a_cost(case):
    cost, message = BAD_COSTS[case]
    horizon = fp.Horizon(stages=3, step=0.1)
    with pytest.raises(InvalidProblem, match=message):
        horizon_of(pendulum(), fp.Trajectory(lambda t: {"angle": 0 * t}), horizon, cost)


def named(name):
    return lambda v: {name: v.state.angle**2 + v.input.torque**2}


def test_a_term_has_no_name_of_another_one():
    """Two of one name were one, and a cost or a limit was lost."""
    with pytest.raises(InvalidProblem, match="term 'held' has the name of"):
        built(fp.CustomCost(terms=named("held")), fp.Horizon(3, 0.1, blocks=(1, 2)))


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
