"""The response Jacobian over a cycle: fitted to a run, and differentiated through the integrator of a reality."""

from __future__ import annotations

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.contraction.spectrum import Array, predicted_factor, response_jacobians
from fpirhc.errors import InvalidShape
from fpirhc.plant.motion import sampling
from fpirhc.sensing.base import response_names
from fpirhc.symbolic.expression import Matrix, kind
from fpirhc.task.problem import Problem

_WINDOW = 15  # times (number of coordinates + 1): the cycles that are used; the transient of a useful gain is shorter
_INDEPENDENT = 1e-3  # share of the size of the requests that each direction must reach, apart from the drift


def identified_factor(
    deformed: Array, realised: Array, effective_gain: float, weights: npt.ArrayLike | None = None
) -> float:
    """Return max|1 - a eig(J W)| with J fitted to a run; NaN when the run does not excite every direction.

        realised[k+1] - realised[k] = J (deformed[k] - deformed[k-1]) + drift

    Only the cycles from the largest increment of the request onwards are used, and the drift there is taken as linear in time:
    later the request only follows the drift of the task, which hides the response of the plant.

    Args:
        deformed: requests, shape (cycles, n).
        realised: responses, shape (cycles, n); row k is the response to the request issued in cycle k - 1.
        weights: W of the deformation, by rows; None: the one matrix.
    """
    requests, responses = np.asarray(deformed, dtype=float), np.asarray(realised, dtype=float)
    if requests.shape != responses.shape or requests.ndim != 2:
        raise InvalidShape(
            f"deformed has shape {requests.shape} but realised {responses.shape}; expected the same, (cycles, n)"
        )
    request_steps, response_steps = np.diff(requests, axis=0)[:-1], np.diff(responses, axis=0)[1:]
    finite = np.isfinite(request_steps).all(axis=1) & np.isfinite(response_steps).all(axis=1)
    request_steps, response_steps = request_steps[finite], response_steps[finite]
    n = request_steps.shape[1]
    count = min(len(request_steps), _WINDOW * (n + 1))
    if count < n + 3:
        return float("nan")
    first = min(int(np.argmax(np.linalg.norm(request_steps, axis=1))), len(request_steps) - count)
    request_steps, response_steps = request_steps[first : first + count], response_steps[first : first + count]
    excitation, answer = _without_trend(request_steps), _without_trend(response_steps)
    smallest = np.linalg.svd(excitation, compute_uv=False)[-1]
    if not smallest > _INDEPENDENT * np.linalg.norm(request_steps):
        return float("nan")
    fitted = np.linalg.lstsq(excitation, answer, rcond=None)[0].T
    return predicted_factor(
        np.linalg.eigvals(fitted if weights is None else fitted @ np.array(weights)), effective_gain
    )


def _without_trend(rows: Array) -> Array:
    """The rows minus their least-squares line in time."""
    time = np.arange(len(rows))
    line = np.vander(time, 2)
    return np.asarray(rows - line @ np.linalg.lstsq(line, rows, rcond=None)[0])


def _sampled_jacobian(problem: Problem) -> ca.Function:
    """Return the Function (reality's state, model's state, request, reality's parameters, model's parameters) -> J (n, n)."""
    model, plant = problem.plant, problem.real_plant
    matrix = kind(model.equations.inverse_opaque or problem.real_integrator.opaque)
    x, state = matrix.sym("x", plant.state.size), matrix.sym("state", model.state.size)
    r, u = matrix.sym("r", len(model.controlled_names)), matrix.sym("u", model.input.size)
    exact, assumed = matrix.sym("exact", len(plant.parameters)), matrix.sym("assumed", len(model.parameters))
    calm = ca.DM.zeros(len(plant.names))
    advance = problem.real_integrator.step(plant, problem.period)
    after = advance(x, u, exact, calm)
    later = matrix.sym("later", model.input.size)
    if problem.integrator.steps_maps:
        response = _differences(problem, advance, after, (later, exact, calm))
    else:
        response = problem.truth.function(response_names(model), seen=True)(after, u, exact, calm)
    gain = ca.Function("fpirhc_sampled_gain", [x, u, later, exact], [ca.densify(ca.jacobian(response, u))])
    command = model.equations.inverse(state, r, assumed)
    jacobian = gain(x, command, command, exact) @ ca.jacobian(command, r)
    names = ["reality", "state", "deformed", "exact", "approximate"]
    arguments = [x, state, r, exact, assumed]
    return ca.Function("fpirhc_sampled_jacobian", arguments, [ca.densify(jacobian)], names, ["jacobian"])


def _differences(problem: Problem, advance: ca.Function, after: Matrix, held: tuple[Matrix, Matrix, ca.DM]) -> Matrix:
    """The divided differences y_{k+r} / T^r of a map's controlled quantities, as far as the command of cycle k changes them.

    Args:
        held: commands of the cycles after it, parameters, no forcing.
    """
    model = problem.plant
    outputs_of = problem.truth.function(model.output.elements, seen=True)
    states, entries = [after], []
    for _ in range(1, max(model.chains.values())):
        states.append(advance(states[-1], *held))
    for name in model.controlled_names:
        order = model.chains[name]
        outputs = outputs_of(states[order - 1], *held)
        entries.append(outputs[model.output.elements.index(name)] / sampling(model) ** order)
    return ca.vertcat(*entries)


def jacobians_along(
    problem: Problem, real: Array, states: Array, deformed: Array, believed: Array, exact: Array
) -> Array:
    """Return J of every row: over a cycle with a reality, and else at an instant; see `sampled_jacobians`."""
    if problem.reality is None:
        return response_jacobians(problem.plant, states, deformed, exact, believed)
    return sampled_jacobians(problem, real, states, deformed, believed, exact)


def sampled_jacobians(
    problem: Problem, real: Array, states: Array, deformed: Array, believed: Array, exact: Array | None = None
) -> Array:
    """Return J of every row with the exact parameters of the reality, shape (rows, n, n).

    Args:
        real: states of the reality, shape (rows, its nx).
        states: states of the model, shape (rows, nx).
        deformed: requests, shape (rows, n).
        believed: parameters of the model, shape (np,), or one set per row.
        exact: parameters of the reality, one set per row; None: its exact ones.
    """
    count, n = len(real), deformed.shape[1]
    true = np.asarray(problem.real_plant.exact if exact is None else exact, dtype=float)
    rows = (np.broadcast_to(v, (count, v.shape[-1])).T for v in (true, np.asarray(believed, dtype=float)))
    stacked = _sampled_jacobian(problem).map(count)(real.T, states.T, deformed.T, *rows)
    return np.asarray(stacked.full()).reshape((n, count, n)).transpose(1, 0, 2)
