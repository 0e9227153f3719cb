"""Eigenvalues of the response Jacobian of a reality: what a request of this cycle has done to the response at the end of it.

The response of a reality with a lag does not see the command at once, so its derivative at an instant is zero. Between two
measurements, the command held, it is

    J = dy^(r)(x(t + T; u), u)/du  du/dr,        u = inverse(state, request; approximate),

differentiated through the integrator of the run. Without a lag and for short periods it is the Jacobian at an instant.
"""

from __future__ import annotations

from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.symbolic.expression import Matrix, kind
from fpirhc.task.problem import Problem

Array: TypeAlias = np.ndarray


def sampled_jacobian(problem: Problem) -> ca.Function:
    """Return the Function (reality's state, model's state, request, reality's parameters, model's parameters) -> J (n, n).

    Raises:
        NotInvertible: the inputs and the controlled coordinates differ in number.
    """
    model, plant, reality = problem.plant, problem.real_plant, problem.symbolic_reality
    matrix = kind(model.inverse_opaque or problem.real_integrator.opaque)
    x, state = matrix.sym("x", plant.state.size), matrix.sym("state", model.state.size)
    r, u = matrix.sym("r", len(model.controlled_names)), matrix.sym("u", model.input.size)
    exact, assumed = matrix.sym("exact", len(plant.parameters)), matrix.sym("assumed", len(model.parameters))
    calm = ca.DM.zeros(len(plant.names))
    advance = problem.real_integrator.step(plant, problem.period)
    after = advance(x, u, exact, calm)
    respond = reality.response_function(model, seen=True) if reality is not None else None
    later = matrix.sym("later", model.input.size)
    if model.step is not None:
        response = _differences(problem, advance, after, (later, exact, calm))
    else:
        response = respond(after, u, exact, calm) if respond else model.controlled_response_function(after, u, exact)
    gain = ca.Function("fpirhc_sampled_gain", [x, u, later, exact], [ca.densify(ca.jacobian(response, u))])
    command = model.inverse_function(state, r, assumed)
    jacobian = gain(x, command, command, exact) @ ca.jacobian(command, r)
    names = ["reality", "state", "deformed", "exact", "approximate"]
    arguments = [x, state, r, exact, assumed]
    return ca.Function("fpirhc_sampled_jacobian", arguments, [ca.densify(jacobian)], names, ["jacobian"])


def _differences(problem: Problem, advance: ca.Function, after: Matrix, held: tuple[Matrix, Matrix, ca.DM]) -> Matrix:
    """The divided differences y_{k+r} / T^r of a map's controlled quantities, as far as the command of cycle k changes them.

    Args:
        problem: its model is a map.
        advance: of the reality over a cycle.
        after: its state one cycle after the command.
        held: commands of the cycles after it, parameters, no forcing.
    """
    model, reality, face = problem.plant, problem.symbolic_reality, problem.plant.face
    if reality is None:
        outputs_of = model.output_function
    else:
        outputs_of = reality.output_function(model) if model.outputs else reality.state_function(model, seen=True)
    states, entries = [after], []
    for _ in range(1, max(face.orders)):
        states.append(advance(states[-1], *held))
    for name, k in zip(model.controlled_names, face.controlled_indices, strict=True):
        outputs = outputs_of(states[face.orders[k] - 1], *held)
        entries.append(outputs[face.state.elements.index(name)] / model.sampling ** face.orders[k])
    return ca.vertcat(*entries)


def sampled_jacobians(
    problem: Problem, real: Array, states: Array, deformed: Array, believed: Array, exact: Array | None = None
) -> Array:
    """Return J of every row with the exact parameters of the reality, shape (rows, n, n).

    Args:
        problem: with a reality.
        real: states of the reality, shape (rows, its nx).
        states: states of the model, shape (rows, nx).
        deformed: requests, shape (rows, n).
        believed: parameters of the model, shape (np,), or one set per row.
        exact: parameters of the reality, one set per row; None: its exact ones.
    """
    count, n = len(real), deformed.shape[1]
    true = np.asarray(problem.real_plant.exact if exact is None else exact, dtype=float)
    rows = (np.broadcast_to(v, (count, v.shape[-1])).T for v in (true, np.asarray(believed, dtype=float)))
    stacked = sampled_jacobian(problem).map(count)(real.T, states.T, deformed.T, *rows)
    return np.asarray(stacked.full()).reshape((n, count, n)).transpose(1, 0, 2)
