"""A model that looks up a table plans in C too: its loops give the leaves room for their work."""

import casadi as ca
import numpy as np
import pytest
from helpers.horizons import horizon_of
from helpers.judging import Judge
from helpers.machine import needs_compiler

import fpirhc as fp
from fpirhc.conformance import compiled

INPUTS, STATES = {"F": (-6.0, 6.0)}, {"x'": (-1.2, 0.8)}


@needs_compiler
@pytest.mark.parametrize("limits", [fp.Limits(INPUTS), fp.Limits(INPUTS, states=STATES)], ids=["inputs", "states"])
def test_a_plan_of_a_model_with_a_table_is_solved_in_c(limits):
    """Drag from measured points: the plan is stationary to a judge of its own, and without limits of states that of the graph."""
    table = ca.interpolant("drag", "bspline", [[-3.0, -1.0, 0.0, 1.0, 3.0]], [-4.0, -0.6, 0.0, 0.6, 4.0])
    plant = fp.Plant(
        coordinates={"x": "m"},
        inputs={"F": "N"},
        order=2,
        parameters={"m": fp.Parameter(1.0, 1.0, "kg")},
        response=lambda q, v, u, p: {"x": (u.F - table(v.x)) / p.m},
    )
    reference = fp.Trajectory(lambda t: {"x": 0.8 * ca.sin(2 * t)})
    cost = fp.Quadratic(states={"x": 30.0, "x'": 0.3}, effort={"F": 1e-2})
    ocp, data = horizon_of(plant, reference, fp.Horizon(stages=10, step=0.1), cost, limits)
    optimiser, first = fp.FixedPointSolver(tolerance=1e-7), np.array([0.4, 0.5])
    graph = optimiser.converging(ocp)
    arguments = first, data, ocp.input_lower, ocp.input_upper, optimiser.memory(ocp).start()
    plan, numbers, _ = (np.asarray(v.full()) for v in compiled(graph)(*arguments))
    assert int(numbers[4, 0]) == fp.Status.OK
    np.testing.assert_allclose(plan, np.asarray(graph(*arguments)[0].full()), atol=1e-7)
    judged = Judge(ocp)(plan, first, data)
    assert (judged.residual <= 1e-5, judged.violation <= 1e-6) == (True, True)
