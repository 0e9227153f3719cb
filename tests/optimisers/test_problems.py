"""The shipped problems: plans agree with an independent solver, and one iteration per cycle is enough."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.horizons import horizon_of
from helpers.kinds import slow_but
from helpers.plants import pendulum

import fpirhc as fp
from fpirhc.conformance import posed
from fpirhc.errors import InvalidValue

PROBLEMS = ("two_mass", "van_der_pol", "cart_pole", "two_link_arm", "chain_of_masses")


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_same_optimum_as_ipopt(name, share):
    """Cost to 1e-6 and inputs to 1e-5 of their range, with the problem's limits and with tighter ones."""
    ocp, first, data = posed(fp.load_problem(name).problem)
    middle, half = (ocp.input_upper + ocp.input_lower) / 2, (ocp.input_upper - ocp.input_lower) / 2
    ocp = replace(ocp, input_lower=middle - share * half, input_upper=middle + share * half)
    scale = float(half.max())
    plan = fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-8 * scale), first, data)
    # IPOPT starts where the other ended: a swing-up has several local optima.
    other = fp.solve(ocp, fp.Ipopt(tolerance=1e-6 * scale, accuracy=1e-11), first, data, start=plan.inputs, calls=3)
    assert plan.status == fp.Status.OK
    assert plan.cost == pytest.approx(other.cost, rel=1e-6)
    np.testing.assert_allclose(plan.inputs, other.inputs, atol=1e-5 * scale)


@pytest.mark.parametrize("name", slow_but(PROBLEMS, "two_mass"))
def test_one_iteration_per_cycle_is_as_good_as_converged_solving(name):
    """The closed-loop cost is within 1 %, with and without adaptation."""
    task = fp.load_problem(name)
    duration = min(task.problem.duration, 2.5)
    problem = replace(task.problem, duration=duration, measure_from=min(task.problem.measure_from, duration / 2))
    if name == "cart_pole":  # tracking with the pole up: a swing-up has several local optima, and each may find another
        problem = replace(problem, start={"cart": 0.2, "angle": 0.2})
    whole = replace(problem, measure_from=0.0)
    for controller in ("RHC", "RHC+FPI"):
        once: Any = task.controllers[controller]
        costs = []
        for selection in (once, replace(once, optimiser=replace(once.optimiser, iterations=12))):
            run = fp.simulate(problem, selection, seed=0)
            assert run.stop is None
            costs.append(fp.measure(whole, run)["cost"]["total"])
        assert costs[0] <= 1.01 * costs[1]


def test_indefinite_costs_are_refused_with_what_to_use_instead():
    """A cost that bends downwards has no quadratic model with a minimum."""
    cost = fp.CustomCost(terms=lambda v: {"down": -(v.state.angle**2), "effort": v.input.torque**2})
    ocp, _ = horizon_of(pendulum(), fp.Trajectory(lambda t: {"angle": 0 * t}), fp.Horizon(5, 0.1), cost)
    with pytest.raises(fp.FpirhcError, match=r"bends upwards.*Use ReducedGradient"):
        fp.solve(ocp, fp.FixedPointSolver(iterations=1, tolerance=1e-6), np.zeros(2), np.zeros((ocp.data.size, 6)))


def test_a_first_plan_at_its_limits_alone_is_sought_again():
    """A valve of the tanks 10 % off: from no input the search ends at an empty tank, in which no pump has an effect."""
    task = fp.load_problem("leaking_tanks")
    valves = dict(task.problem.plant.parameters)
    valves["s2"] = replace(valves["s2"], approximate=4.4e-5)
    problem = replace(task.problem, plant=replace(task.problem.plant, parameters=valves), duration=60.0)
    ocp, first, data = posed(problem)
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-6)
    empty = fp.solve(ocp, optimiser, first, data, start=np.zeros((1, ocp.stages)))
    assert empty.status == fp.Status.OK
    assert not empty.inputs.any()
    found = fp.solve(ocp, optimiser, first, data)
    assert found.cost == pytest.approx(fp.solve(ocp, fp.Ipopt(tolerance=1e-6), first, data).cost, rel=1e-6)
    assert found.cost < 1e-3 * empty.cost
    run = fp.simulate(problem, task.controllers["RHC"], seed=0, compiled=False)
    assert run["command"].min() > 40.0
    assert fp.measure(problem, run).rms_error["h2"] < 0.03


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"state": np.zeros(3)}, InvalidValue, "state has the shape (3,), expected (4,)"),
        ({"data": np.zeros((2, 2))}, InvalidValue, "data has the shape (2, 2), expected"),
        ({"start": np.zeros((3, 3))}, InvalidValue, "start has the shape (3, 3), expected (2, 20)"),
        ({"state": np.full(4, np.nan)}, InvalidValue, "state is not finite"),
    ],
)
def test_what_is_solved_has_its_shape(change, error, text):
    ocp, first, data = posed(fp.load_problem("two_mass").problem)
    optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-8)
    every = {"state": first, "data": data, **change}
    with pytest.raises(error, match=re.escape(text)):
        fp.solve(ocp, optimiser, every.pop("state"), every.pop("data"), **every)
