"""Eigenvalues of the response Jacobian J = df/dr, and the gains that converge: |1 - a lambda| < 1 for every eigenvalue lambda.

J is that of the equations, of a cycle of a reality differentiated through its integrator, or fitted to a run.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.deformation.base import Deformation, own_gain, with_its_gain
from fpirhc.errors import NotContractive
from fpirhc.plant.plant import Plant
from fpirhc.summary import number, written_out
from fpirhc.symbolic.evaluate import require_unsolved
from fpirhc.symbolic.expression import Matrix, kind
from fpirhc.task.problem import Problem

Array: TypeAlias = np.ndarray

MEND = "the plant answers in the direction opposite to that of its model: mend the sign in the model"
_NO_SIGN = 1e-9  # real parts below this share of the largest eigenvalue have no sign


def jacobians_along(
    problem: Problem, real: Array, states: Array, deformed: Array, believed: Array, exact: Array
) -> Array:
    """Return J of every row, shape (rows, n, n): over a cycle with a reality, and else at an instant.

    Args:
        real: states of the reality, shape (rows, its nx); without one they are not read.
        states: states of the model, shape (rows, nx).
        deformed: requests, shape (rows, n).
        believed: parameters of the model, shape (np,), or one set per row.
        exact: parameters of the reality, one set per row.
    """
    given = [states, deformed, exact, believed]
    if problem.reality is None:
        function = _response_jacobian(problem.plant)
    else:
        function, given = _sampled_jacobian(problem), [real, *given]
    count, n = len(states), deformed.shape[1]
    rows = [np.broadcast_to(np.asarray(v, dtype=float), (count, v.shape[-1])) for v in given]
    try:
        stacked = np.asarray(function.map(count)(*(v.T for v in rows)).full())
        return stacked.reshape((n, count, n)).transpose(1, 0, 2)
    except RuntimeError as error:  # Newton's method has no derivative where the inputs have no effect
        require_unsolved(error)
    return np.array([_value(function, n, row) for row in zip(*rows, strict=True)])


@lru_cache(maxsize=16)  # one run needs it several times
def _response_jacobian(plant: Plant) -> ca.Function:
    """Return Function (state, deformed, exact, approximate) -> J = df/dr of the controlled coordinates, n x n.

    f(r) = response(state, inverse(state, r; approximate); exact)
    """
    matrix = kind(plant.equations.inverse_opaque)
    x = matrix.sym("x", plant.state.size)
    r = matrix.sym("r", len(plant.controlled_names))
    exact = matrix.sym("exact", plant.parameter.size if plant.parameters else 0)
    assumed = matrix.sym("approximate", exact.numel())
    realised = plant.equations.controlled_response(x, plant.equations.inverse(x, r, assumed), exact)
    jacobian = ca.densify(ca.jacobian(realised, r))
    names = ["state", "deformed", "exact", "approximate"]
    return ca.Function("fpirhc_response_jacobian", [x, r, exact, assumed], [jacobian], names, ["jacobian"])


def _value(function: ca.Function, n: int, row: tuple[Array, ...]) -> Array:
    """The Jacobian of one row; NaN where it cannot be computed."""
    try:
        return np.asarray(function(*row).full())
    except RuntimeError as error:
        require_unsolved(error)
        return np.full((n, n), np.nan)


def _sampled_jacobian(problem: Problem) -> ca.Function:
    """Return the Function (reality's state, model's state, request, reality's parameters, model's parameters) -> J (n, n)."""
    model, plant = problem.plant, problem.real_plant
    matrix = kind(model.equations.inverse_opaque)
    x, state = matrix.sym("x", plant.state.size), matrix.sym("state", model.state.size)
    r, u = matrix.sym("r", len(model.controlled_names)), matrix.sym("u", model.input.size)
    exact, assumed = matrix.sym("exact", len(plant.parameters)), matrix.sym("assumed", len(model.parameters))
    calm = ca.DM.zeros(len(plant.names))
    advance = problem.real_integrator.step(plant, problem.period)
    after = advance(x, u, exact, calm)
    later = matrix.sym("later", model.input.size)
    response = _response(problem, advance, after, u, (later, exact, calm))
    gain = ca.Function("fpirhc_sampled_gain", [x, u, later, exact], [ca.densify(ca.jacobian(response, u))])
    command = model.equations.inverse(state, r, assumed)
    jacobian = gain(x, command, command, exact) @ ca.jacobian(command, r)
    names = ["reality", "state", "deformed", "exact", "approximate"]
    arguments = [x, state, r, exact, assumed]
    return ca.Function("fpirhc_sampled_jacobian", arguments, [ca.densify(jacobian)], names, ["jacobian"])


def _response(
    problem: Problem, advance: ca.Function, after: Matrix, command: Matrix, held: tuple[Matrix, Matrix, ca.DM]
) -> Matrix:
    """The response to the command of a cycle, or of a map the divided differences y_{k+r} / T^r as far as it changes them."""
    counts, orders = problem.plant.differences, problem.plant.response_orders
    names = [name + "'" * (order - counts[name]) for name, order in orders.items()]
    shown, state = problem.reality_or_model.function(names, seen=True), after
    values = {0: shown(after, command, *held[1:])}
    for count in range(1, max(counts.values()) + 1):
        values[count] = shown(state, *held) / problem.period**count
        state = advance(state, *held)
    return ca.vertcat(*(values[count][k] for k, count in enumerate(counts.values())))


def predicted_factor(eigenvalues: Array, effective_gain: float) -> float:
    """Return max|1 - a lambda|, the factor by which an error of the request shrinks per cycle (grows, above 1)."""
    return float(np.abs(1 - effective_gain * np.asarray(eigenvalues)).max())


def linear_limit(eigenvalues: Array) -> tuple[float, float]:
    """Return the open interval of effective gains with |1 - a lambda| < 1 for every eigenvalue.

    One end is 0, the other is min 2 Re(lambda) / |lambda|^2, with a minus sign where all real parts are negative.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    flat = np.asarray(eigenvalues, dtype=complex).ravel()
    least, most, small = flat.real.min(), flat.real.max(), _NO_SIGN * np.abs(flat).max()
    if not (least > small or most < -small):
        raise NotContractive(
            "the input gains of the plant, over those of the model, have both signs or are zero (from "
            f"{number(least)} to {number(most)}), so no gain makes the iteration converge: "
            "it enlarges the error in some direction. Check that each input acts on its own coordinate and that the "
            "approximate parameters give the effect of every input its true sign"
        )
    outer = float((2 * np.abs(flat.real) / np.abs(flat) ** 2).min())
    return (0.0, outer) if least > 0 else (-outer, 0.0)


def sector_limit(deformation: Deformation, eigenvalues: Array) -> tuple[float, float]:
    """Return the interval of effective gains whose steepest secant is also within the linear limit.

    Within it the iteration on a linear plant converges from errors of any size, because every step is the step of some linear map
    that contracts. Outside it large errors may end in a bounded two-cycle.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    lower, upper = linear_limit(eigenvalues)
    if deformation.effective_gain() == 0:
        return lower, upper
    right = deformation.with_effective_gain(0.5 * (lower + upper))  # the secant depends on the gain's sign
    steeper = right.secant_gain() / right.effective_gain()
    return lower / steeper, upper / steeper


@dataclass(frozen=True)
class ContractionReport:
    """Whether a deformation converges on plants with a given spectrum, and which gains do.

    Within the sector limit errors of any size converge. Between the two limits only small errors converge, and a large one may end
    in a bounded oscillation. Where no gain converges the limits are empty. These are limits of the map on a plant; those of the
    whole loop, and a recommended gain, are answers of a review.
    """

    predicted: float  # max|1 - a lambda|, the factor of an error of the request per cycle
    linear_limit: tuple[float, float]  # interval of the effective gain in which small errors converge
    sector_limit: tuple[float, float]  # interval of the effective gain in which errors of any size converge
    text: str  # the verdict, for a reader
    converging: str = ""  # the gains that converge, behind an estimator too; empty where its own does not


def assess_gain(
    deformation: Deformation, eigenvalues: Array, late: float = 0.0, largest: float = np.inf
) -> ContractionReport:
    """Return whether a deformation converges on plants with these eigenvalues, with the fault and what would do instead.

    A gain between the sector and the linear limit is no fault. Where the response is late by some cycles, the factor is that
    without this delay, and the text says so; the limits end at the `largest` gain behind it, where that is finite.
    """
    gain, (name, value) = deformation.effective_gain(), own_gain(deformation)
    predicted = predicted_factor(eigenvalues, gain)
    try:
        if gain == 0:
            raise NotContractive(f"{deformation} does not iterate, so nothing contracts", "use Sigmoid(gain=...)")
        linear, sector = linear_limit(eigenvalues), sector_limit(deformation, eigenvalues)
    except NotContractive as error:
        none = (0.0, 0.0)
        return ContractionReport(predicted, none, none, str(error))
    scale, what, fault = value / gain, with_its_gain(deformation), ""
    near, any_size = ((max(lower, -largest), min(upper, largest)) for lower, upper in (linear, sector))
    ends = [abs(scale * sum(limit)) for limit in (near, any_size)]  # one end of a limit is zero
    converging = (
        f"a {'positive' if scale * sum(linear) > 0 else 'negative'} {name}, 0 < |{name}| < {written_out(ends[0])}"
    )
    if not np.isclose(ends[0], ends[1]):
        converging += f", and below {written_out(ends[1])} to converge from errors of any size"
    behind = f" (if the response came at once; it is {number(late)} cycles late)" if late else ""
    text = f"{what} leaves at most {written_out(predicted)} of an error of the request per cycle{behind}"
    if not sector[0] < gain < sector[1]:
        text += ", but only a small one: beyond the sector limit large errors may end in a bounded oscillation"
    remedy = f"use {converging}{behind if largest == np.inf else ''}"
    if gain * sum(linear) < 0:
        fault = f"{what} has the wrong sign, so every cycle enlarges the error"
        converging = MEND if gain > 0 else remedy
    elif abs(gain) >= abs(sum(linear)):
        fault = f"{what} is too large: errors grow by the factor {written_out(predicted)} per cycle"
        converging = remedy
    if fault:
        text, converging = f"{fault}; {converging}", ""
    return ContractionReport(predicted, near, any_size, text, converging)


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
    weighted = fitted if weights is None else fitted @ np.array(weights)
    return predicted_factor(np.linalg.eigvals(weighted), effective_gain)


def _without_trend(rows: Array) -> Array:
    """The rows minus their least-squares line in time."""
    time = np.arange(len(rows))
    line = np.vander(time, 2)
    return np.asarray(rows - line @ np.linalg.lstsq(line, rows, rcond=None)[0])
