"""The horizon: auxiliary function, adjoint gradient, costs and their mistakes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.plants import chain, pendulum

import fpirhc as fp
from fpirhc.contracts import reduced_gradient
from fpirhc.errors import InvalidProblem, InvalidValue
from fpirhc.horizon.problem import rollout
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.full_space import auxiliary_gradient, auxiliary_hessian

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
        rate=True,
    ),
}


def built(cost, horizon=None, plant=None, limits=None):
    """(ocp, data) of a pendulum's horizon."""
    selection, steps = plant or pendulum(), horizon or fp.Horizon(stages=8, step=0.05)
    ocp = transcribe(selection, PENDULUM_REFERENCE, steps, cost, limits or fp.Limits())
    return ocp, stage_data(selection, PENDULUM_REFERENCE, steps, cost)(0.2, selection.approximate)


def point(ocp, seed=0):
    """A random first state and plan."""
    random = np.random.default_rng(seed)
    return random.normal(size=ocp.state.size), random.normal(size=(ocp.input.size, ocp.stages))


@pytest.mark.parametrize("name", COSTS)
@pytest.mark.parametrize("discretisation", [fp.RungeKutta4(), fp.Euler()])
def test_adjoint_gradient_is_the_gradient_of_the_auxiliary_function(name, discretisation):
    """With the multipliers that make grad_S Psi vanish, grad_U Psi is the reduced gradient, and the states are feasible."""
    ocp, data = built(COSTS[name], fp.Horizon(stages=8, step=0.05, discretisation=discretisation))
    s0, inputs = point(ocp)
    _, slope, states, costates = reduced_gradient(ocp)(s0, inputs, data, np.zeros((ocp.state.size, ocp.stages)))
    by_state, by_input, by_multiplier = auxiliary_gradient(ocp)(states[:, 1:], inputs, -costates[:, 1:], s0, data)
    assert float(ca.norm_inf(ca.vec(by_state))) < 1e-10
    assert float(ca.norm_inf(ca.vec(by_input - slope))) < 1e-10
    assert float(ca.norm_inf(ca.vec(by_multiplier))) < 1e-12


@pytest.mark.parametrize("name", COSTS)
def test_adjoint_gradient_agrees_with_finite_differences(name):
    """An independent check, by central differences of the rolled-out cost."""
    ocp, data = built(COSTS[name])
    s0, inputs = point(ocp, 1)
    slope = reduced_gradient(ocp)(s0, inputs, data, np.zeros((ocp.state.size, ocp.stages)))[1].full()
    value = rollout(ocp)
    for k in (0, 3, ocp.stages - 1):
        direction = np.zeros_like(inputs)
        direction[0, k] = 1e-5
        high, low = (float(value(s0, inputs + sign * direction, data)[1]) for sign in (1, -1))
        assert slope[0, k] == pytest.approx((high - low) / 2e-5, rel=1e-5, abs=1e-7)


def test_kkt_matrix_is_symmetric_and_indefinite():
    """The Hessian of Psi has N (nx + nu) positive and N nx negative eigenvalues at a convex point."""
    ocp, data = built(COSTS["deviation"])
    s0, inputs = point(ocp)
    n = ocp.stages
    states = rollout(ocp)(s0, inputs, data)[0][:, 1:]
    hessian = auxiliary_hessian(ocp)(states, inputs, np.zeros((ocp.state.size, n)), s0, data).full()
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12)
    eigenvalues = np.linalg.eigvalsh(hessian)
    assert (eigenvalues > 0).sum() == n * (ocp.state.size + ocp.input.size)
    assert (eigenvalues < 0).sum() == n * ocp.state.size


def test_terms_add_up_to_the_cost():
    ocp, data = built(COSTS["rate"])
    s0, inputs = point(ocp)
    states, value, terms = rollout(ocp)(s0, inputs, data)
    final = ocp.terminal_cost(states[:, -1], data[:, -1])
    assert ocp.terms == ("states", "effort", "rate")
    assert float(value) == pytest.approx(float(ca.sum1(terms) + final))


def test_rate_cost_counts_the_change_from_the_last_command():
    """The previous input is part of the stage's state; holding it costs nothing."""
    ocp, data = built(fp.Quadratic(states={"angle": 0.0}, rate={"torque": 2.0}))
    first = np.array([0.1, 0.0, 0.7])
    held = rollout(ocp)(first, np.full((1, ocp.stages), 0.7), data)
    jump = rollout(ocp)(first, np.full((1, ocp.stages), 1.7), data)
    assert float(held[1]) == 0.0
    assert float(jump[1]) == pytest.approx(2.0 * ocp.step)


def test_lqr_terminal_makes_a_short_horizon_endless():
    """On a linear plant at rest the planned first input is the infinite-horizon LQR input, however short the horizon."""
    plant, reference = chain(2), fp.Trajectory(lambda t: {"y": 0 * t})
    cost = fp.Quadratic(states={"y": 3.0, "y'": 0.5}, effort={"u": 0.2}, terminal=fp.LQRTerminal())
    horizon = fp.Horizon(stages=3, step=0.1)
    ocp = transcribe(plant, reference, horizon, cost, fp.Limits())
    data = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate)
    plan = fp.solve(ocp, fp.ReducedGradient(iterations=100, tolerance=1e-9), np.array([1.0, -0.3]), data)
    a, b = np.array([[1, 0.1], [0, 1]]), np.array([[0.005], [0.1]])
    import control  # takes a second, which every process would pay

    gain, _, _ = control.dlqr(a, b, np.diag([3.0, 0.5]), np.array([[0.2]]))
    assert plan.status == fp.Status.OK
    np.testing.assert_allclose(plan.inputs[:, 0], -np.asarray(gain) @ [1.0, -0.3], rtol=1e-6)


def test_arrays_are_taken_where_tuples_are():
    """An array of two entries is neither true nor equal to another one, and a list has no hash."""

    def made(of: Callable[[tuple[object, ...]], Any]) -> fp.Horizon:
        entries = {"lengths": of((1.0, 2.0)), "blocks": of((1, 1)), "terminal": of(("angle",))}
        return fp.Horizon(stages=2, step=0.1, **entries)

    for kind in (np.array, list):
        assert made(kind) == made(kind) == made(tuple)
        assert hash(made(kind)) == hash(made(tuple))


def test_the_end_of_a_horizon_has_the_input_of_its_last_stage_as_the_one_before():
    """Also where a change of the input counts with the time that it takes."""
    cost = fp.CustomCost(
        terms=lambda v: {"a": (v.input.torque - v.input_before.torque) ** 2},
        terminal=lambda v: v.input_before.torque,
        rate=True,
    )
    ocp, data = built(cost, fp.Horizon(stages=4, step=0.1, lengths=(1, 2, 4, 8)))
    assert float(ocp.terminal_cost([0.0, 0.0, 3.0], data[:, -1])) == 3.0


def test_feedforward_makes_the_reference_free():
    """On the reference, with the model's own input, a cost of corrections is zero."""
    ocp, data = built(COSTS["deviation"])
    values = ocp.data.split(data[:, 0])
    value, _ = ocp.stage_cost(values["reference"], values["feedforward"], data[:, 0])
    assert float(value) == pytest.approx(0.0, abs=1e-20)


BAD_COSTS = {
    "state": (fp.Quadratic(states={"angel": 1.0}), "'angel' is unknown. Did you mean 'angle'"),
    "input": (fp.Quadratic(states={"angle": 1.0}, effort={"torqe": 1.0}), "Did you mean 'torque'"),
    "zero": (fp.Quadratic(states={"angle": 0.0}), "every weight is zero"),
    "term": (fp.CustomCost(terms=lambda v: {"log": ca.log(v.state.angle)}), "term 'log' is -inf"),
    "name": (fp.CustomCost(terms=lambda v: {"a": v.state.angel}), "state 'angel' is unknown"),
    "before": (fp.CustomCost(terms=lambda v: {"a": v.input_before.torque}), "say CustomCost\\(rate=True\\)"),
    "end": (
        fp.CustomCost(lambda v: {"a": v.input.torque**2}, terminal=lambda v: v.input.torque),
        "end .* has no input",
    ),
    "lqr": (fp.Quadratic(states={"angle": 1.0}, terminal=fp.LQRTerminal()), "needs a positive effort"),
    "feedforward": (fp.CustomCost(terms=lambda v: {"a": v.feedforward.torque}), "say CustomCost\\(feedforward=True\\)"),
    "final": (
        fp.CustomCost(terms=lambda v: {"a": v.input.torque**2}, terminal=lambda v: 1 / v.state.angle),
        "term 'terminal' is inf",
    ),
    "shape": (fp.CustomCost(terms=lambda v: {"a": v.state.vector}), r"term 'a' must be one scalar, got shape \(2, 1\)"),
    "empty": (fp.CustomCost(terms=lambda v: {}), "at least one entry"),
    # Not a mapping, which is refused.
    "kind": (
        fp.CustomCost(terms=lambda v: v.input.torque**2),  # type: ignore[arg-type, return-value]
        "must be {name: expression}",
    ),
    "many": (fp.Quadratic(states={"angel": 1.0, "angle": 1.0}, effort={"torqe": 1.0}), "2 mistakes"),
}


@pytest.mark.parametrize("case", BAD_COSTS)
def test_mistakes_of_a_cost(case):
    cost, message = BAD_COSTS[case]
    horizon = fp.Horizon(stages=3, step=0.1)
    with pytest.raises(InvalidProblem, match=message):
        transcribe(pendulum(), fp.Trajectory(lambda t: {"angle": 0 * t}), horizon, cost, fp.Limits())


def test_mistakes_of_a_horizon():
    """No stages, no step, an integrator that a horizon cannot hold."""
    with pytest.raises(InvalidValue, match=r"Horizon.stages: expected a whole number from 1 to"):
        fp.Horizon(stages=0, step=0.1)
    with pytest.raises(InvalidValue, match=r"Horizon.step: expected a number from"):
        fp.Horizon(stages=3, step=0.0)
    with pytest.raises(InvalidValue, match="RungeKutta4"):
        fp.Horizon(stages=3, step=0.1, discretisation=fp.Cvodes())
    with pytest.raises(InvalidProblem, match=r"does not divide the horizon step 0.01 s; use a step of 0.009 s"):
        fp.Problem(
            plant=tasks.two_mass.problem.plant,
            reference=tasks.two_mass.problem.reference,
            start=tasks.two_mass.problem.start,
            period=3e-3,
            duration=1.0,
            horizon=fp.Horizon(stages=5, step=1e-2),
        )


def test_a_period_that_is_advised_is_taken():
    """Its digits are enough: a step of 0.34 s has no third of few digits."""
    with pytest.raises(InvalidProblem) as refused:
        replace(tasks.two_mass.problem, period=0.1, horizon=fp.Horizon(stages=5, step=0.34))
    advised = float(str(refused.value).split("a period of ")[1].split(" s")[0])
    assert replace(tasks.two_mass.problem, period=advised, horizon=fp.Horizon(stages=5, step=0.34))


def named(name):
    return lambda v: {name: v.state.angle**2 + v.input.torque**2}


def test_a_term_has_no_name_of_another_one():
    """Two of one name were one, and a cost or a limit was lost."""
    for name, horizon in (("soft angle", fp.Horizon(stages=3, step=0.1)), ("held", fp.Horizon(3, 0.1, blocks=(1, 2)))):
        limits = fp.Limits(states={"angle": (-1.0, 1.0)}, soft={"angle": 1.0})
        cost = fp.CustomCost(terms=named(name))
        with pytest.raises(InvalidProblem, match=f"term '{name}' has the name of"):
            built(cost, horizon, limits=limits)


def test_curvature_is_the_bend_of_the_cost_along_the_first_input():
    """On a linear plant it is the second derivative of V, and it scales with the weights."""
    plant, reference = chain(2), fp.Trajectory(lambda t: {"y": ca.sin(t)})
    horizon = fp.Horizon(stages=6, step=0.1)
    for factor in (1.0, 1e-7):
        cost = fp.Quadratic(
            states={"y": 3.0 * factor}, effort={"u": 0.2 * factor}, rate={"u": factor}, terminal={"y'": 5.0 * factor}
        )
        ocp = transcribe(plant, reference, horizon, cost, fp.Limits())
        data = stage_data(plant, reference, horizon, cost)(0.0, plant.approximate)
        s0, inputs = point(ocp)
        value = [float(rollout(ocp)(s0, inputs + k * np.eye(1, 6), data)[1]) for k in (-1, 0, 1)]
        assert ocp.curvature[0] == pytest.approx((value[0] - 2 * value[1] + value[2]) / ocp.step, rel=1e-6)


def test_curvature_of_a_flat_cost_is_positive():
    """|e|^4 has no curvature on the reference; the scale must still be usable."""
    cost = fp.CustomCost(terms=lambda v: {"a": (v.state.angle - v.reference.angle) ** 4})
    assert built(cost)[0].curvature == pytest.approx([1.0])


def test_a_table_serves_as_a_reference():
    """A sampled reference gives the same stage data as the expression that it was sampled from."""
    times = np.linspace(0.0, 2.0, 201)
    table = fp.Table(times, {"angle": 0.5 * np.sin(2 * times)})
    horizon, plant = fp.Horizon(stages=8, step=0.05), pendulum()
    _, expected = built(COSTS["deviation"])
    values = stage_data(plant, table, horizon, COSTS["deviation"])(0.2, plant.approximate)
    np.testing.assert_allclose(values.full(), expected.full(), atol=1e-5)
    transcribe(plant, table, horizon, COSTS["deviation"], fp.Limits())


def test_horizons_of_plants_with_other_exact_parameters_are_the_same_one():
    """A plan knows the approximate parameters alone: its horizon is that of a plant which is built anew with these exact ones."""
    problem = tasks.two_mass.problem
    plant, other = problem.plant, problem.with_exact(1.1 * problem.plant.exact).plant
    believed = {name: replace(p, approximate=1.1 * p.approximate) for name, p in plant.parameters.items()}

    def horizon(plant):
        start = problem.start_state
        assert problem.horizon is not None
        assert problem.cost is not None
        return transcribe(plant, problem.reference, problem.horizon, problem.cost, problem.limits, start=start)

    shared, anew = horizon(plant), horizon(replace(plant, parameters=other.parameters))
    assert horizon(other) is shared
    assert anew is not shared
    for one, same in zip(anew.nodes, shared.nodes, strict=True):
        np.testing.assert_array_equal(one, same)
    assert not np.array_equal(horizon(replace(plant, parameters=believed)).nodes[2], shared.nodes[2])
