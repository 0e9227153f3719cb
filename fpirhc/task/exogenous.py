"""Signals from outside: quantities that act on a plant and that nobody controls, such as weather, load, demand or prices.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import expression, graph, kind
from fpirhc.symbolic.layout import Expression

_FILLED: Latest[ca.Function] = Latest(16)  # every run asks for those of the plant and of the model


@dataclass(frozen=True, eq=False)
class Exogenous(Checked):
    """What acts on the plant, and how much of it the model is told: `Known` or `Unknown`."""

    values: Course
    told: ClassVar[bool]  # whether the model has the values, also of the future; else it goes on with the nominal one


class Known(Exogenous):
    """A signal that the model has as it is, also along a horizon: `Samples`, an expression as a function of time, or a number."""

    told = True


class Unknown(Exogenous):
    """The same that the plant gets and the model does not: the model has the nominal value."""

    told = False


def real_values(plant: Plant, signals: Mapping[str, Exogenous]) -> ca.Function | None:
    """Function (time, parameters) -> parameters with the real values of the signals; None where the plant has none."""
    courses = {name: one.values for name, one in signals_of(plant, signals).items()}
    if not courses:
        return None
    elements = plant.parameter.elements
    key = tuple(courses), elements
    return _FILLED.of(tuple(courses.values()), key, lambda: _filling(elements, courses))


def model_values(plant: Plant, signals: Mapping[str, Exogenous]) -> ca.Function | None:
    """Function (time, parameters) -> parameters with what the model is told of a time; None where it is told nothing."""
    return real_values(plant, {name: one for name, one in signals.items() if one.told})


def signals_of(plant: Plant, signals: Mapping[str, Exogenous]) -> dict[str, Exogenous]:
    """Return the signals that a plant has."""
    return {name: signals[name] for name in plant.outside if name in signals}


def really_known(signals: Mapping[str, Exogenous]) -> Mapping[str, Exogenous]:
    """Return the same signals, told to the model as they are: what an exact model knows."""
    return {name: Known(one.values) for name, one in signals.items()}


def rows_of(function: ca.Function | None, times: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the parameters at some times, shape (m, np): the same row m times where there is no function."""
    if function is None:
        return np.repeat(parameters[None, :], len(times), axis=0)
    columns = function.map(len(times))(times[None, :], np.repeat(parameters[:, None], len(times), axis=1))
    return np.asarray(columns.full()).T


def check_signals(
    plants: Collection[Plant], signals: Mapping[str, Exogenous], times: np.ndarray, mistakes: Mistakes
) -> None:
    """Add every mistake of the signals to `mistakes`. `plants`: the model, and the plant of a reality where there is one."""
    units: dict[str, str] = {}
    for plant in plants:
        for name in plant.outside:
            unit = plant.parameters[name].unit
            if units.setdefault(name, unit) != unit:
                mistakes.add(f"signals: '{name}' is in {units[name]} in the model, in {unit} in the reality; write one")
            if name not in signals:
                mistakes.add(
                    f"signals: '{name}' [{unit}] has no values; add signals={{'{name}': Known(Samples(times, values))}}, or Unknown"
                )
    ordinary = {name for plant in plants for name in plant.parameters} - units.keys()
    for name in ordinary & signals.keys():
        mistakes.add(f"signals: '{name}' is a parameter; declare it as outside(nominal=..., unit=...) in the plant")
    mistakes.unknown("signals: name", signals.keys() - ordinary, units)
    for name, one in signals.items():
        _check_course(f"signals: values of '{name}'", one.values, times, mistakes)


def _check_course(what: str, course: Course, times: np.ndarray, mistakes: Mistakes) -> None:
    first = float(course.times[0]) if isinstance(course, Samples) else -math.inf
    if first > times[0]:
        mistakes.add(f"{what} are stated from {first:g} on, and the run begins at {times[0]:g}; add a sample")
        return
    with mistakes.caught(f"{what}: "):
        values = np.asarray(_course_function([course]).map(times.size)(times[None, :]).full()).ravel()
        if not np.isfinite(values).all():
            mistakes.add(f"{what} are not finite at t = {times[int(np.argmin(np.isfinite(values)))]:g}")


def _filling(elements: Sequence[str], courses: Mapping[str, Course]) -> ca.Function:
    matrix = kind(_opaque(courses.values()))
    t, p = matrix.sym("t"), matrix.sym("p", len(elements))
    values = dict(zip(courses, ca.vertsplit(_course_function(list(courses.values()))(t)), strict=True))
    entries = [values.get(name, p[k]) for k, name in enumerate(elements)]
    return ca.Function("fpirhc_signals", [t, p], [ca.densify(ca.vertcat(*entries))], ["t", "p"], ["parameters"])


@dataclass(frozen=True, eq=False)
class Samples(Checked):
    """Samples of a quantity over time, each held until the next one; `lambda t: ca.pw_lin(t, times, values)` joins them by lines.

    Args:
        times: increasing times of the samples, shape (m,), in the plant's unit of time; a run needs the first one at its start.
        values: the samples, shape (m,).

    Raises:
        InvalidValue: times that do not increase, numbers that are not finite, lengths that differ, or no sample.
    """

    times: Sequence[float] | np.ndarray
    values: Sequence[float] | np.ndarray

    def __post_init__(self) -> None:
        times, values = (np.asarray(v, dtype=float) for v in (self.times, self.values))
        if times.ndim != 1 or not times.size or values.shape != times.shape:
            raise InvalidValue(
                f"Samples: times have shape {times.shape} and values {values.shape}; expected one value per time, at least 1"
            )
        if not (np.isfinite(times).all() and np.isfinite(values).all()) or np.any(np.diff(times) <= 0):
            raise InvalidValue("Samples: times and values must be finite, and the times must increase")

    def __call__(self, t: Expression) -> Expression:
        """Return the value at a time."""
        times, values = (np.asarray(v, dtype=float) for v in (self.times, self.values))
        # `low` never returns the last entry, so one more entry makes the last sample reachable.
        place = ca.low(ca.DM(np.append(times, times[-1] + 1.0)), graph(t))
        return expression(ca.MX(ca.DM(values))[place])


Course: TypeAlias = Samples | Callable[[Expression], Expression] | float


def _opaque(courses: Iterable[Course]) -> bool:
    """Whether some course needs operations that scalar expressions cannot hold."""
    return any(isinstance(course, Samples) for course in courses)


def _course_function(courses: Sequence[Course]) -> ca.Function:
    """Function time -> the value of every course, shape (number of courses,)."""
    matrix = kind(_opaque(courses))
    t = matrix.sym("t")
    values = [_value(course, t) for course in courses]
    return ca.Function("fpirhc_courses", [t], [ca.densify(ca.vertcat(*map(matrix, values)))], ["t"], ["values"])


def _value(course: Course, t: Expression) -> Expression:
    if not callable(course):
        return scalar_expression("signal", course)
    if isinstance(t, ca.MX) and not _opaque([course]):  # it may use what is there for scalar expressions alone
        own = ca.SX.sym("t")
        return ca.Function("fpirhc_course", [own], [_value(course, own)])(t)
    return scalar_expression("signal", called("signal", course, t), of=course, symbols=(t,))
