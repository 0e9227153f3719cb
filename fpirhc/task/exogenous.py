"""Signals from outside: quantities that act on a plant and that nobody controls, such as weather, load, demand or prices.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidShape, InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.plant.integrators import Integrator
from fpirhc.plant.motion import outside_names
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import expression, graph, kind
from fpirhc.symbolic.layout import Expression

_FILLED: Latest[ca.Function] = Latest(16)  # every run asks for those of the plant and of the model
_REAL: Latest[Mapping[str, Exogenous]] = Latest(8)
_LOOKED: Latest[np.ndarray] = Latest(8)  # every variant of a problem is checked


class Exogenous(Checked, ABC):
    """Contract: what a signal really is, and what the model is told of it.

    Attributes:
        values: what acts on the plant.
        preview: whether a horizon has the model's values of the future; else those of the cycle are held along it.
    """

    values: Course
    preview: bool = False

    @property
    @abstractmethod
    def known(self) -> Course | None:
        """Values that the model has; None: the nominal one."""


@dataclass(frozen=True, eq=False)
class Known(Exogenous):
    """A signal that the model has as it is.

    Args:
        values: `Samples`, a function of time that returns an expression, or a number.
        preview: whether the future is known too, as from a schedule or a forecast; False: only the value of the cycle, as from a
            sensor.
    """

    values: Course
    preview: bool = True

    @property
    def known(self) -> Course:
        return self.values


@dataclass(frozen=True, eq=False)
class Unknown(Exogenous):
    """A signal that the plant gets and the model does not: the model has the nominal value.

    Args:
        values: `Samples`, a function of time that returns an expression, or a number.
    """

    values: Course

    @property
    def known(self) -> None:
        """Nothing."""


@dataclass(frozen=True, eq=False)
class Believed(Exogenous):
    """A signal of which the model is told something else, such as a wrong forecast.

    Args:
        values: what acts on the plant.
        model: what the model is told.
        preview: whether the model has its values of the future too.
    """

    values: Course
    model: Course
    preview: bool = True

    @property
    def known(self) -> Course:
        return self.model


def real_values(plant: Plant, signals: Mapping[str, Exogenous]) -> ca.Function | None:
    """Function (time, parameters) -> parameters with the real values of the signals; None where the plant has none."""
    return _filled(plant, {n: signals[n].values for n in outside_names(plant) if n in signals})


def model_values(plant: Plant, signals: Mapping[str, Exogenous]) -> ca.Function | None:
    """Function (time, parameters) -> parameters with what the model is told at this time; None where it is told nothing."""
    courses = {n: signals[n].known for n in outside_names(plant) if n in signals}
    return _filled(plant, {n: course for n, course in courses.items() if course is not None})


def previewed_values(plant: Plant, signals: Mapping[str, Exogenous]) -> ca.Function | None:
    """Function (time, parameters) -> parameters with what the model is told of a later time; None where it is told nothing."""
    return model_values(plant, {n: one for n, one in signals.items() if one.preview})


def known_places(plant: Plant, signals: Mapping[str, Exogenous]) -> tuple[int, ...]:
    """Places of the signals among the parameters of which the model is told something."""
    names = [n for n in outside_names(plant) if n in signals and signals[n].known is not None]
    return tuple(plant.parameter.elements.index(n) for n in names)


def signals_of(plant: Plant, signals: Mapping[str, Exogenous]) -> dict[str, Exogenous]:
    """Return the signals that a plant has."""
    return {name: one for name, one in signals.items() if name in outside_names(plant)}


def really_known(signals: Mapping[str, Exogenous]) -> Mapping[str, Exogenous]:
    """Return the same signals, told to the model as they are: what an exact model knows."""
    values = {name: one.values for name, one in signals.items()}
    return _REAL.of(tuple(values.values()), tuple(values), lambda: {name: Known(one) for name, one in values.items()})


def as_known(plant: Plant, signals: Mapping[str, Exogenous]) -> dict[str, Exogenous]:
    """Return signals that are what the model believes: the world of a null test."""
    nominal = {name: plant.parameters[name].approximate for name in outside_names(plant)}
    made: dict[str, Exogenous] = {}
    for name, one in signals_of(plant, signals).items():
        course = one.known
        made[name] = Known(nominal[name] if course is None else course, preview=one.preview or course is None)
    return made


def not_held(signals: Mapping[str, Exogenous], names: Sequence[str]) -> tuple[str, ...]:
    """Return those of some signals that change between jumps, really or as the model is told."""
    courses = {name: (signals[name].values, signals[name].known) for name in names if name in signals}
    return tuple(n for n, both in courses.items() if not all(c is None or _is_held(c) for c in both))


def rows_of(function: ca.Function | None, times: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the parameters at some times, shape (m, np): the same row m times where there is no function."""
    if function is None:
        return np.repeat(parameters[None, :], len(times), axis=0)
    columns = function.map(len(times))(times[None, :], np.repeat(parameters[:, None], len(times), axis=1))
    return np.asarray(columns.full()).T


def check_signals(
    plants: Sequence[Plant], signals: Mapping[str, Exogenous], times: np.ndarray, mistakes: Mistakes
) -> None:
    """Add every mistake of the signals to `mistakes`. `plants`: the model, and the plant of a reality where there is one."""
    units: dict[str, str] = {}
    for plant in plants:
        for name in outside_names(plant):
            unit = plant.parameters[name].unit
            if units.setdefault(name, unit) != unit:
                mistakes.add(
                    f"signals: '{name}' is in {units[name]} in the model and in {unit} in the reality; write one unit"
                )
            if name not in signals:
                mistakes.add(
                    f"signals: '{name}' [{unit}] has no values; add signals={{'{name}': Known(Samples(times, values))}}, or Unknown"
                )
    ordinary = {name for plant in plants for name in plant.parameters} - units.keys()
    for name in ordinary & signals.keys():
        mistakes.add(f"signals: '{name}' is a parameter; declare it as outside(nominal=..., unit=...) in the plant")
    mistakes.unknown("signals: name", signals.keys() - ordinary, units)
    for name, one in signals.items():
        for what, course in (("values", one.values), ("values of the model", one.known)):
            if course is not None and (what == "values" or course is not one.values):
                _check_course(f"signals: {what} of '{name}'", course, times, mistakes)


_OF_MODELS = ContextVar("fpirhc_signals_of_models", default=False)


@contextmanager
def signals_of_models() -> Iterator[None]:
    """Within it no signal is refused: a model in place of a reality of finer steps holds it over its cycles, rightly or not."""
    token = _OF_MODELS.set(True)
    try:
        yield
    finally:
        _OF_MODELS.reset(token)


_LOOKS = 8, 128  # at a signal within a step: fewest and most, a pulse between two of which nobody sees
_MOST_STEPS = 20_000  # that are looked at
_HELD_WELL = 0.1  # share of the range of its means over steps by which one may differ from the value in the middle, which is held


def check_held(
    plant: Plant, signals: Mapping[str, Exogenous], duration: float, period: float, steps: int, own: Integrator
) -> None:
    """Raise for a signal that changes within one of the `steps` of what moves in a cycle: the value in its middle acts all through.

    Raises:
        InvalidProblem: names the signal, and the first such cycle.
    """
    names = [n for n in outside_names(plant) if n in signals]
    if not names or _OF_MODELS.get():
        return
    courses, mistakes = [signals[n].values for n in names], Mistakes("")
    count, step = round(duration / period) * steps, period / steps
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_STEPS)).astype(int))
    looks = _LOOKED.of(tuple(courses), (count, step), lambda: _looked(courses, chosen, step))
    means, range_ = looks[:, :-1].mean(axis=1), np.ptp(looks, axis=(0, 1))
    arrives = np.maximum(np.ptp(means, axis=0), (1e-2 if len(chosen) > 1 else 1.0) * range_)  # a short pulse is high
    off = np.abs(means - looks[:, -1]) / np.maximum(arrives, 1e-9 * np.abs(looks).max(axis=(0, 1)) + 1e-300)
    for k, name in enumerate(names):
        if off[:, k].max() > _HELD_WELL:
            first = chosen[int(np.argmax(off[:, k] > _HELD_WELL))]
            cycle, unit = first // steps, plant.time_unit
            finer = f"{type(own).__name__ if hasattr(own, 'substeps') else 'Collocation'}(substeps={2 * steps})"
            mistakes.add(
                f"signals: '{name}' changes within the step of {step:g} {unit} at t = {first * step:g} {unit} (cycle {cycle}), and "
                "the value in its middle would act all through it; let it change between steps, or give a reality finer steps, "
                + ("a map with a shorter step" if plant.step else f"Reality(..., integrator={finer})")
            )
    mistakes.raise_if_any()


def _looked(courses: Sequence[Course], steps: np.ndarray, step: float) -> np.ndarray:
    """Values of the courses, shape (steps, looks, courses): all through every step, and last in its middle."""
    many = int(np.clip(_LOOKS[0] * _MOST_STEPS / len(steps), *_LOOKS))
    inside = (np.append(np.arange(many), (many - 1) / 2) + 0.5) / many
    times = ((steps[:, None] + inside) * step).reshape(1, -1)
    values = np.asarray(_course_function(courses).map(times.size)(times).full())
    return values.T.reshape(len(steps), len(inside), len(courses))


def _check_course(what: str, course: Course, times: np.ndarray, mistakes: Mistakes) -> None:
    first, last = _span_of(course)
    if first > times[0] or last < times[-1]:
        mistakes.add(
            f"{what} are stated from {first:g} to {last:g}, the run is from {times[0]:g} to {times[-1]:g}; add samples"
        )
        return
    with mistakes.caught(f"{what}: "):
        values = np.asarray(_course_function([course]).map(times.size)(times[None, :]).full()).ravel()
        if not np.isfinite(values).all():
            mistakes.add(f"{what} are not finite at t = {times[int(np.argmin(np.isfinite(values)))]:g}")


def _filled(plant: Plant, courses: Mapping[str, Course]) -> ca.Function | None:
    elements = plant.parameter.elements
    key = tuple(courses), elements
    return _FILLED.of(tuple(courses.values()), key, lambda: _filling(elements, courses)) if courses else None


def _filling(elements: Sequence[str], courses: Mapping[str, Course]) -> ca.Function:
    matrix = kind(any(map(_is_opaque, courses.values())))
    t, p = matrix.sym("t"), matrix.sym("p", len(elements))
    values = dict(zip(courses, ca.vertsplit(_course_function(list(courses.values()))(t)), strict=True))
    entries = [values.get(name, p[k]) for k, name in enumerate(elements)]
    return ca.Function("fpirhc_signals", [t, p], [ca.densify(ca.vertcat(*entries))], ["t", "p"], ["parameters"])


@dataclass(frozen=True, eq=False)
class Samples(Checked):
    """Samples of a quantity over time.

    Before the first and after the last sample the nearest one holds; a run needs samples that cover it (see `span`).

    Args:
        times: increasing times of the samples, shape (m,), in the plant's unit of time.
        values: the samples, shape (m,).
        hold: "zero": a sample holds until the next one; "linear": lines join the samples.

    Raises:
        InvalidValue: times that do not increase, numbers that are not finite, an unknown hold.
        InvalidShape: lengths that differ, or too few samples.
    """

    times: Sequence[float] | np.ndarray
    values: Sequence[float] | np.ndarray
    hold: Literal["zero", "linear"] = "zero"

    def __post_init__(self) -> None:
        times, values = (np.asarray(v, dtype=float) for v in (self.times, self.values))
        least = 1 if self.hold == "zero" else 2
        if times.ndim != 1 or times.size < least or values.shape != times.shape:
            raise InvalidShape(
                f"Samples: times have shape {times.shape} and values {values.shape}; expected one value per time, at least {least}"
            )
        if not (np.isfinite(times).all() and np.isfinite(values).all()) or np.any(np.diff(times) <= 0):
            raise InvalidValue("Samples: times and values must be finite, and the times must increase")

    opaque = True

    @property
    def held(self) -> bool:
        """Whether the values are constant between jumps."""
        return self.hold == "zero"

    @property
    def span(self) -> tuple[float, float]:
        """First and last time with a stated value; a last sample that is held goes on for ever."""
        times = np.asarray(self.times, dtype=float)
        return float(times[0]), math.inf if self.hold == "zero" else float(times[-1])

    def __call__(self, t: Expression) -> Expression:
        """Return the value at a time."""
        times, values = (np.asarray(v, dtype=float) for v in (self.times, self.values))
        at = graph(t)
        if self.hold == "zero":
            # `low` never returns the last entry, so one more entry makes the last sample reachable.
            place = ca.low(ca.DM(np.append(times, times[-1] + 1.0)), at)
            return expression(ca.MX(ca.DM(values))[place])
        place, slopes = ca.low(ca.DM(times), at), np.diff(values) / np.diff(times)
        inside = ca.fmin(ca.fmax(at, times[0]), times[-1])
        begin, value, slope = (ca.MX(ca.DM(v))[place] for v in (times[:-1], values[:-1], slopes))
        return expression(value + slope * (inside - begin))


Course: TypeAlias = Samples | Callable[[Expression], Expression] | float


def _is_opaque(course: Course) -> bool:
    """Whether a course needs operations that scalar expressions cannot."""
    return bool(getattr(course, "opaque", False))


def _is_held(course: Course) -> bool:
    """Whether a course is constant between jumps, as a number and samples that are held are."""
    return not callable(course) or bool(getattr(course, "held", False))


def _span_of(course: Course) -> tuple[float, float]:
    """First and last time for which a course has values; infinite where it has no end."""
    first, last = getattr(course, "span", (-math.inf, math.inf))
    return float(first), float(last)


def _course_function(courses: Sequence[Course]) -> ca.Function:
    """Function time -> the value of every course, shape (number of courses,)."""
    matrix = kind(any(map(_is_opaque, courses)))
    t = matrix.sym("t")
    values = [_value(course, t) for course in courses]
    return ca.Function("fpirhc_courses", [t], [ca.densify(ca.vertcat(*map(matrix, values)))], ["t"], ["values"])


def _value(course: Course, t: Expression) -> Expression:
    if not callable(course):
        return scalar_expression("signal", course)
    return scalar_expression("signal", called("signal", course, t), of=course, symbols=(t,))
