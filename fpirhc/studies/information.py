"""What each measured quantity allows to know of the residual: the smallest error of any estimate, before a run.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.reference_states import nominal_motion, reference_states
from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import checked_call
from fpirhc.plant.maps import step_of
from fpirhc.plant.motion import known_exactly
from fpirhc.sensing.base import response_names
from fpirhc.summary import number, table
from fpirhc.symbolic.live import nominal
from fpirhc.task.problem import Problem

_SLOW = 0.02  # omega T below which the formula is exact to 4 %, and the Riccati equation loses its digits
_HEAD = ("coordinate", "measured", "noise", "smallest error", "by formula", "bandwidth", "gain margin")
_SAMPLES = 2000  # of the reference, at most


@dataclass(frozen=True)
class Reachable:
    """What one measured quantity allows."""

    coordinate: str  # controlled coordinate
    measured: str  # the quantity: its response, or a derivative below
    order: int  # n, one more than the number of integrators between the residual and the quantity
    noise: float  # s, deviation per sample, in its unit
    error: float  # smallest deviation of the residual from any estimate of it, one cycle ahead, in the response's unit
    formula: float  # the same by the formula of slow filters
    bandwidth: float  # omega, rad per unit of time; infinite without noise
    gain: float  # T omega up to 1 for n = 1, the gain of the deformation that reaches it; NaN for others
    margin: float  # largest gain of the plant, in units of the model's, that the filter survives by itself


@dataclass(frozen=True)
class InformationComparison:
    """What every measured quantity allows, the best first within a coordinate."""

    rows: tuple[Reachable, ...]  # one per measured quantity
    drift: Mapping[str, float]  # D of every controlled coordinate, response unit / s^0.5
    # rms of the residual along the reference by coordinate: the error without any correction; empty where D was given
    residual: Mapping[str, float]

    def best(self, coordinate: str) -> Reachable:
        """Return the row with the smallest error."""
        return next(row for row in self.rows if row.coordinate == coordinate)

    def __str__(self) -> str:
        rows = [_HEAD, *self._cells()]
        widths = [max(len(row[k]) for row in rows) for k in range(len(_HEAD))]
        return "\n".join(" ".join(f"{cell:>{w}}" for cell, w in zip(row, widths, strict=True)) for row in rows)

    def _repr_html_(self) -> str:
        return table("What each measured quantity allows", _HEAD, self._cells())

    def _cells(self) -> list[tuple[str, ...]]:
        return [
            (r.coordinate, r.measured, *map(number, (r.noise, r.error, r.formula, r.bandwidth, r.margin)))
            for r in self.rows
        ]


@checked_call
def compare_information(problem: Problem, *, drift: Mapping[str, float] | None = None) -> InformationComparison:
    """Return how well the residual of the model can be known from each measured quantity, whatever the controller.

    Args:
        problem: with its sensors, of which the noise counts, its period, and the exact parameters.
        drift: D by controlled coordinate; None: that of the residual along the reference, rms change per cycle over T^0.5, with the
            exact parameters.

    Raises:
        InvalidProblem: an unknown coordinate, or a drift that is not positive.
        InvalidValue: no `drift` beside a reality, of which the reference tells no states.
    """
    task = nominal(problem)
    residual: dict[str, float] = {}
    if drift is None:
        drift, residual = _along_reference(task)
    _check(task, drift)
    rows: list[Reachable] = []
    for name, order in task.plant.response_orders.items():
        chain = [name + "'" * k for k in range(order + 1)]
        measured = [e for e in chain if e in task.sensing.measures(task.plant)]
        own = [_reachable(task, name, e, order - e.count("'") + 1, drift[name]) for e in measured]
        rows += sorted(own, key=lambda row: row.error)
    return InformationComparison(tuple(rows), dict(drift), residual)


def filter_gain_margin(order: int) -> float:
    """Return the largest lambda for which s^n + ... + lambda has no root on the right, the rest that of a Butterworth filter.

    Infinite for n = 1 and 2; 4, and 1 + 2^0.5 for n = 3 and 4.
    """
    angles = np.pi * (2 * np.arange(order) + order + 1) / (2 * order)
    polynomial = np.real(np.poly(np.exp(1j * angles)))
    if order < 3:
        return math.inf
    # On the imaginary axis s = i y the polynomial without its last coefficient is real: -lambda.
    powers = 1j ** np.arange(order, -1, -1)
    imaginary = np.imag(polynomial * powers)
    roots = np.roots(np.trim_zeros(imaginary, "b"))
    crossings = [float(r.real) for r in roots if abs(r.imag) < 1e-9 and r.real > 1e-9]
    rest = np.append(polynomial[:-1], 0.0)
    gains = [-float(np.real(np.polyval(rest, 1j * y))) for y in crossings]
    return min(g for g in gains if g > 1)


def _reachable(problem: Problem, name: str, measured: str, order: int, drift: float) -> Reachable:
    noise, period = _noise(problem, measured), problem.period
    power = noise**2 * period
    bandwidth = (drift**2 / power) ** (0.5 / order) if noise else math.inf
    formula = math.sqrt(drift ** (2 - 1 / order) * power ** (0.5 / order) / math.sin(math.pi / (2 * order)))
    error = formula if bandwidth * period < _SLOW else _sampled(problem, order, drift, noise)
    gain = min(1.0, bandwidth * period) if order == 1 else math.nan
    return Reachable(name, measured, order, noise, error, formula, bandwidth, gain, filter_gain_margin(order))


def _sampled(problem: Problem, order: int, drift: float, noise: float) -> float:
    """Deviation one cycle ahead of the optimal filter in cycles, by its Riccati equation, in units of what drifts in a cycle."""
    from scipy.linalg import solve_discrete_are  # only here: the import takes longer than that of the whole package

    step, change = problem.period, drift * math.sqrt(problem.period)
    chain = np.asarray(step_of(problem.plant, np.eye(order, k=1), step))
    scale = step ** -np.arange(order - 1.0, -1.0, -1.0)  # of the quantities, so that the matrices have no units
    a = chain * scale[:, None] / scale[None, :]
    shown, moves = np.eye(order)[:1], np.zeros((order, order))
    moves[-1, -1] = 1.0
    relative = max(noise * scale[0] / change, 1e-6)
    covariance = solve_discrete_are(a.T, shown.T, moves, np.array([[relative**2]]))
    return float(change * math.sqrt(covariance[-1, -1]))


def _noise(problem: Problem, measured: str) -> float:
    sensor = problem.sensing.sensors.get(measured)
    if sensor is None:
        return 0.0
    deviation = 0.0 if sensor.noise is None else float(getattr(sensor.noise, "deviation", 0.0))
    quantum = 0.0 if sensor.quantum is None else float(sensor.quantum)
    return math.hypot(deviation, quantum / math.sqrt(12))


def _along_reference(problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
    """Drift and rms of the residual f - f^ along the reference, by controlled coordinate."""
    plant = problem.plant
    if problem.reality is not None:
        raise InvalidValue(
            "compare_information: the reference tells no states of a reality; give the drift, drift={'"
            + plant.controlled_names[0]
            + "': ...}, in units of the response per square root of the time's unit"
        )
    equations, first = plant.equations, round(problem.measure_from / problem.period)
    rows = slice(first, first + min(_SAMPLES, problem.cycles - first))
    times = problem.period * np.arange(problem.cycles + 1)[rows]
    states = reference_states(replace(problem, plant=known_exactly(plant)), problem.cycles + 1)[:, rows]
    _, responses = nominal_motion(problem).map(len(times))(times[None, :])
    commands = equations.inverse.map(len(times))(states, responses, np.tile(plant.exact[:, None], len(times)))
    believed = equations.controlled_response.map(len(times))(
        states, commands, np.tile(plant.approximate[:, None], len(times))
    )
    series = np.asarray((responses - believed).full()).T
    changes = np.sqrt(np.mean(np.diff(series, axis=0) ** 2, axis=0) / problem.period)
    sizes = np.sqrt(np.mean(series**2, axis=0))
    names = plant.controlled_names
    return dict(zip(names, map(float, changes), strict=True)), dict(zip(names, map(float, sizes), strict=True))


def _check(problem: Problem, drift: Mapping[str, float]) -> None:
    mistakes, names = Mistakes("compare_information"), problem.plant.controlled_names
    mistakes.unknown("drift: controlled coordinate", drift, names)
    for name in names:
        if not drift.get(name, 0.0) > 0 or not math.isfinite(drift[name]):
            mistakes.add(
                f"drift: the residual of '{name}' does not drift, or its density is missing; give drift={{'{name}': ...}}, a "
                f"positive number in units of {response_names(problem.plant)[names.index(name)]} per square root of the time's unit"
            )
    mistakes.raise_if_any()
