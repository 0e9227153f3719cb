"""Eigenvalues of the response Jacobian J = df/dr, and the gains that converge: |1 - a lambda| < 1 for every eigenvalue lambda.

J is that of the equations, of a cycle of a reality differentiated through its integrator, or fitted to a run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.deformation.base import Deformation, own_gain, with_its_gain
from fpirhc.errors import InvalidShape, InvalidValue, NotContractive
from fpirhc.fields.checked import checked_call
from fpirhc.plant.motion import sampling
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import response_names
from fpirhc.summary import line, number, table
from fpirhc.symbolic.evaluate import Evaluator, require_unsolved
from fpirhc.symbolic.expression import Matrix, kind
from fpirhc.task.problem import Problem

Array: TypeAlias = np.ndarray

LARGEST_SAMPLE = 2000  # cycles of a run whose eigenvalues are computed; longer runs are thinned evenly
_NO_SIGN = 1e-9  # real parts below this share of the largest eigenvalue have no sign


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues of the response Jacobian.

    Args:
        eigenvalues: one row per sample, shape (samples, n), complex; rows that are not finite are left out.

    Raises:
        InvalidValue: no row is finite.
    """

    eigenvalues: Array

    def __post_init__(self) -> None:
        rows = np.atleast_2d(np.asarray(self.eigenvalues, dtype=complex))
        finite = rows[np.isfinite(rows).all(axis=1)]
        if finite.size == 0:
            raise InvalidValue(
                "no finite eigenvalue of the response Jacobian: the inverse response is singular at every sample; "
                "check that the inputs act on the controlled coordinates there"
            )
        values = np.array(finite)
        values.setflags(write=False)
        object.__setattr__(self, "eigenvalues", values)

    @cached_property
    def smallest_real(self) -> float:
        """Smallest real part."""
        return float(self.eigenvalues.real.min())

    @cached_property
    def largest_real(self) -> float:
        """Largest real part."""
        return float(self.eigenvalues.real.max())

    @cached_property
    def one_sign(self) -> bool:
        """Whether all real parts have the same sign and none is zero."""
        small = _NO_SIGN * float(np.abs(self.eigenvalues).max())
        return self.smallest_real > small or self.largest_real < -small


@lru_cache(maxsize=16)  # one run needs it several times
def response_jacobian(plant: Plant) -> ca.Function:
    """Return Function (state, deformed, exact, approximate) -> J = df/dr of the controlled coordinates, n x n.

        f(r) = response(state, inverse(state, r; approximate); exact)

    Raises:
        NotInvertible: the inputs and the controlled coordinates differ in number.
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


@checked_call
def spectrum_over_run(
    plant: Plant, states: Array, deformed: Array, *, exact: Array | None = None, approximate: Array | None = None
) -> Spectrum:
    """Return the eigenvalues of J along a run; long runs are thinned to `LARGEST_SAMPLE` cycles.

    Args:
        states: state of every cycle, shape (cycles, nx): run["state"].
        deformed: request of every cycle, shape (cycles, n): run["deformed"].
        exact: parameters of the plant, shape (np,); None: its exact ones.
        approximate: parameters of the model, shape (np,); None: the plant's approximate ones.

    Raises:
        InvalidShape: arrays that do not fit the plant or each other.
        InvalidValue: no finite eigenvalue.
    """
    states, deformed = _rows(plant, states, deformed)
    rows = _thinned(len(states))
    true = np.tile(plant.exact if exact is None else np.asarray(exact, dtype=float), (len(rows), 1))
    return _spectrum(response_jacobians(plant, states[rows], deformed[rows], true, approximate))


def _rows(plant: Plant, states: Array, deformed: Array) -> tuple[Array, Array]:
    states, deformed = (np.atleast_2d(np.asarray(rows, dtype=float)) for rows in (states, deformed))
    widths = (plant.state.size, len(plant.controlled_names))
    if (states.shape[1], deformed.shape[1]) != widths or not len(states) == len(deformed) > 0:
        raise InvalidShape(
            f"states {states.shape} and deformed {deformed.shape}: expected (cycles, {widths[0]}) and (cycles, {widths[1]}), "
            "of at least one cycle"
        )
    return states, deformed


def _spectrum(jacobians: Array) -> Spectrum:
    return Spectrum(np.linalg.eigvals(jacobians[np.isfinite(jacobians).all(axis=(1, 2))]))


def factors_along(cycles: int, jacobians_at: Callable[[Array], Array], effective_gain: float) -> Array:
    """Return the predicted factor max|1 - a lambda| of every cycle of a run, shape (cycles,); every entry is a number.

    Long runs are evaluated at `LARGEST_SAMPLE` cycles, and in between the last value holds. Where J is singular or not
    finite nothing contracts, and the factor is 1.

    Args:
        jacobians_at: function of the numbers of some cycles -> their Jacobians, shape (cycles, n, n).
    """
    rows = _thinned(cycles)
    jacobians = jacobians_at(rows)
    finite = np.isfinite(jacobians).all(axis=(1, 2))
    factors = np.ones(len(rows))
    factors[finite] = np.abs(1 - effective_gain * np.linalg.eigvals(jacobians[finite])).max(axis=1)
    return factors[np.searchsorted(rows, np.arange(cycles), side="right") - 1]


def response_jacobians(plant: Plant, states: Array, deformed: Array, exact: Array, approximate: Array | None) -> Array:
    """Return J of every row, shape (rows, n, n); not finite where the model's inverse is not.

    Args:
        states: shape (rows, nx).
        deformed: requests, shape (rows, n).
        exact: parameters of the plant, one set per row, shape (rows, np).
        approximate: parameters of the model, shape (np,), or one set per row; None: the plant's own.
    """
    model = plant.approximate if approximate is None else np.asarray(approximate, dtype=float)
    function, n = response_jacobian(plant), deformed.shape[1]
    count = len(states)
    assumed = np.broadcast_to(model, (count, model.shape[-1]))
    try:
        [columns] = Evaluator(function.map(count))(states, deformed, exact, assumed)
        return columns.reshape(count, n, n).transpose(0, 2, 1)
    except RuntimeError as error:  # Newton's method has no derivative where the inputs have no effect
        require_unsolved(error)
    except InvalidValue:  # the same, of a buffer, which does not say what failed; the call by itself does
        pass
    return np.array([_value(function, n, row) for row in zip(states, deformed, exact, assumed, strict=True)])


def _value(function: ca.Function, n: int, row: tuple[Array, ...]) -> Array:
    """The Jacobian of one row; NaN where it cannot be computed."""
    try:
        return np.asarray(function(*row).full())
    except RuntimeError as error:
        require_unsolved(error)
        return np.full((n, n), np.nan)


def _thinned(cycles: int) -> Array:
    """Numbers of at most `LARGEST_SAMPLE` cycles, evenly chosen, with the first and the last."""
    return np.unique(np.linspace(0, cycles - 1, min(cycles, LARGEST_SAMPLE)).astype(int))


def predicted_factor(eigenvalues: Array, effective_gain: float) -> float:
    """Return max|1 - a lambda|, the factor by which an error of the request shrinks per cycle (grows, above 1)."""
    return float(np.abs(1 - effective_gain * np.asarray(eigenvalues)).max())


def linear_limit(eigenvalues: Array) -> tuple[float, float]:
    """Return the open interval of effective gains with |1 - a lambda| < 1 for every eigenvalue.

    One end is 0, the other is min 2 Re(lambda) / |lambda|^2, with a minus sign where all real parts are negative.
    """
    spectrum = Spectrum(eigenvalues)
    _require_one_sign(spectrum)
    flat = spectrum.eigenvalues.ravel()
    outer = float((2 * np.abs(flat.real) / np.abs(flat) ** 2).min())
    return (0.0, outer) if spectrum.smallest_real > 0 else (-outer, 0.0)


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


def _require_one_sign(spectrum: Spectrum) -> None:
    """Check that some gain converges."""
    if not spectrum.one_sign:
        raise NotContractive(
            "the response Jacobian has eigenvalues with real parts of both signs or zero (from "
            f"{spectrum.smallest_real:.4g} to {spectrum.largest_real:.4g}), so no gain makes the iteration converge: "
            "it enlarges the error in some direction. Check that each input acts on its own coordinate and that the "
            "approximate parameters give the effect of every input its true sign"
        )


@dataclass(frozen=True)
class ContractionReport:
    """Whether a deformation converges on plants with a given spectrum, and which gains do.

    Within the sector limit errors of any size converge. Between the two limits only small errors converge, and a large one may end
    in a bounded oscillation. Where no gain converges the limits are empty. These are limits of the map on a plant; those of the
    whole loop, and a recommended gain, are answers of a review.
    """

    predicted: float  # max|1 - a lambda|, the factor of an error of the request per cycle
    effective_gain: float  # a of the deformation
    gain_name: str  # name of the gain that the user sets, the deformation's own gain
    linear_limit: tuple[float, float]  # interval of the effective gain in which small errors converge
    sector_limit: tuple[float, float]  # interval of the effective gain in which errors of any size converge
    own_linear_limit: tuple[float, float]  # the linear limit in the deformation's own gain
    own_sector_limit: tuple[float, float]  # the sector limit in the deformation's own gain
    contractive: bool  # whether the effective gain is within the linear limit
    within_sector: bool  # whether the effective gain is within the sector limit
    text: str  # the verdict and the admissible gains, for a reader
    fault: str = ""  # what is wrong; empty where the deformation converges
    remedy: str = ""  # what would do instead

    def __repr__(self) -> str:
        return line(self, *(f"{name} {value}" for name, value in self._facts()))

    def _repr_html_(self) -> str:
        """Factor and limits as a table, for notebooks."""
        return table("Contraction", ("", "value"), self._facts(), [self.text])

    def _facts(self) -> list[tuple[str, str]]:
        """Verdict, factor and limits, by name; the limits in the deformation's own gain."""
        linear, sector = (f"({a:.4g}, {b:.4g})" for a, b in (self.own_linear_limit, self.own_sector_limit))
        return [
            ("contractive", "yes" if self.contractive else "no"),
            ("within the sector limit", "yes" if self.within_sector else "no"),
            ("predicted factor", number(self.predicted)),
            (f"linear limit of {self.gain_name}", linear),
            (f"sector limit of {self.gain_name}", sector),
        ]


def check_gain(deformation: Deformation, spectrum: Spectrum, late: float = 0.0) -> ContractionReport:
    """Return the report of a deformation that converges on plants with these eigenvalues.

    A gain between the sector and the linear limit is not refused: `within_sector` is False in its report. Where the response is
    late by some cycles, the limits are those without this delay, and the text says so.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or a gain that is zero, of the wrong sign, or beyond the linear
            limit; the message names the admissible gains.
    """
    report = assess_gain(deformation, spectrum, late)
    if not report.contractive:
        raise NotContractive(report.fault, report.remedy)
    return report


def assess_gain(deformation: Deformation, spectrum: Spectrum, late: float = 0.0) -> ContractionReport:
    """Return the report of `check_gain`; where `check_gain` raises, a report with `contractive` False and the same text."""
    gain = deformation.effective_gain()
    name, own = own_gain(deformation)
    predicted = predicted_factor(spectrum.eigenvalues, gain)
    try:
        linear = linear_limit(spectrum.eigenvalues)
    except NotContractive as error:
        return _hopeless(predicted, gain, name, error)
    if gain == 0:
        fault = f"{deformation} does not iterate, so nothing contracts"
        return _hopeless(predicted, gain, name, NotContractive(fault, "use Sigmoid(gain=...)"))
    sector = sector_limit(deformation, spectrum.eigenvalues)
    own_linear, own_sector = (_scaled(limit, own / gain) for limit in (linear, sector))
    contractive, within = linear[0] < gain < linear[1], sector[0] < gain < sector[1]
    admissible = _admissible(name, own_linear, own_sector, late)
    what = with_its_gain(deformation)
    fault, remedy = ("", "") if contractive else (f"{what} {_fault(gain, linear, predicted)}", f"use {admissible}")
    return ContractionReport(
        predicted=predicted,
        effective_gain=gain,
        gain_name=name,
        linear_limit=linear,
        sector_limit=sector,
        own_linear_limit=own_linear,
        own_sector_limit=own_sector,
        contractive=contractive,
        within_sector=within,
        text=f"{fault}; {remedy}" if fault else _verdict(what, predicted, within, admissible),
        fault=fault,
        remedy=remedy,
    )


def _hopeless(predicted: float, gain: float, name: str, refusal: NotContractive) -> ContractionReport:
    none = (0.0, 0.0)
    limits, why = (none, none, none, none), (str(refusal), refusal.fault, refusal.remedy)
    return ContractionReport(predicted, gain, name, *limits, False, False, *why)


def _fault(gain: float, linear: tuple[float, float], predicted: float) -> str:
    if gain * sum(linear) < 0:
        return "has the wrong sign, so every cycle enlarges the error"
    return f"is too large: errors grow by the factor {predicted:.3g} per cycle"


def _scaled(limit: tuple[float, float], factor: float) -> tuple[float, float]:
    ends = sorted(end * factor + 0.0 for end in limit)
    return ends[0], ends[1]


def _size(limit: tuple[float, float]) -> float:
    return max(abs(limit[0]), abs(limit[1]))


def _admissible(name: str, linear: tuple[float, float], sector: tuple[float, float], late: float) -> str:
    sign = "positive" if sum(linear) > 0 else "negative"
    bounds = f"0 < |{name}| < {_size(linear):.3g}"
    if not np.isclose(_size(linear), _size(sector)):
        bounds += f", and below {_size(sector):.3g} to converge from errors of any size"
    behind = f", without the response's delay of {late:.4g} cycles" if late else ""
    return f"a {sign} {name}, {bounds}{behind}"


def _verdict(what: str, predicted: float, within: bool, admissible: str) -> str:
    text = f"{what} leaves at most {predicted:.3g} of an error of the request per cycle"
    if not within:
        text += (
            ", but only a small one: it is beyond the sector limit, where large errors may end in a bounded oscillation"
        )
    return f"{text}. Admissible: {admissible}."


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

    `held`: commands of the cycles after it, parameters, no forcing.
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
