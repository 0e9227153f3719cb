"""Settings of a controller by dotted path, and the ranges in which tuning searches for them, linear or logarithmic."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar

from fpirhc.controllers.base import Controller
from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import expects_whole_number
from fpirhc.fields.kinds import finite_number
from fpirhc.symbolic.layout import Signal
from fpirhc.symbolic.paths import changed_at, content_at, names_in
from fpirhc.task.cases import PARAMETERS, START, Cases
from fpirhc.task.problem import Problem

Values = Mapping[str, float]
_DIGITS = 4  # of every number that is tried, so that a written number is exactly the tried one


Owner = TypeVar("Owner", Controller, Problem)


def with_settings(owner: Owner, values: Values) -> Owner:
    """Return a controller, or a problem, with other values of some settings.

    Args:
        owner: the controller or the problem; it stays as it is.
        values: path -> number. A path leads through fields, keys of mappings and places of tuples, with dots in between:
            'deformation.gain', 'cost.states.q1', of a problem 'plant.parameters.mass.exact'.

    Raises:
        InvalidName: no such setting; the nearest one is offered.
        InvalidValue: the setting is not a number, or does not accept this one.
    """
    changed = owner
    for path, value in values.items():
        current_setting(owner, path)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InvalidValue(f"setting '{path}': expected a number, got {value!r}")
        if is_whole(owner, path) and not isinstance(value, int):
            raise InvalidValue(f"setting '{path}': expected a whole number, got {value!r}")
        changed = changed_at(changed, path, value)
    return changed


def of_problem(problem: Problem, path: str) -> str | None:
    """Return a path as a case has it, 'exact.m1' for 'm1.exact'; None where it does not begin with a word of a case."""
    name, _, word = path.rpartition(".")
    named = word in PARAMETERS and (name in problem.plant.parameters or name in problem.moved.parameters)
    of_case = f"{word}.{name}" if named else path
    return of_case if of_case.partition(".")[0] in {*PARAMETERS, START, *(f.name for f in fields(problem))} else None


def with_numbers(problem: Problem, values: Mapping[str, Any]) -> Problem:
    """Return a problem with other numbers at paths of a case, see `Cases`, or as `of_problem` takes them."""
    changes = {of_problem(problem, path) or path: value for path, value in values.items()}
    return Cases({_SET: changes}).problem(_SET, problem) if values else problem


_SET = "--set"


def is_own(controller: Controller, path: str) -> bool:
    """Whether a path begins with a field of the controller that it has: a number that problem and controller have is its own."""
    return getattr(controller, path.partition(".")[0], None) is not None


def as_declared(controller: Controller, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return numbers of settings, as whole numbers where the controller has such."""
    plain = {p for p, v in values.items() if isinstance(v, tuple) or v % 1 or not is_whole(controller, p)}
    return {p: v if p in plain else int(v) for p, v in values.items()}


def unit_of_setting(path: str, problem: Problem) -> str:
    """Return the unit of a setting of a controller or of the problem, '' where its kind does not say it."""
    word, _, name = path.partition(".")
    if word in PARAMETERS:
        return (problem.moved if word == "exact" else problem.plant).parameters[name].unit
    if word == START:
        return _units(problem.plant.state)[name]
    if word == "limits":
        kind, _, name = name.partition(".")
        units = _units(problem.plant.input if kind == "inputs" else problem.plant.state)
        return units.get(name) or units.get(name.rpartition(".")[0], "")
    return problem.time_unit if word in _TIMES else ""


_TIMES = ("dead_time", "duration", "measure_from", "period")  # fields of a problem


def _units(signal: Signal) -> dict[str, str]:
    return dict(zip(signal.elements, signal.entry_units, strict=True))


def current_setting(owner: Controller | Problem, path: str) -> float:
    """Return the number at a path."""
    value = content_at(owner, path, "the problem" if isinstance(owner, Problem) else "the controller")
    if isinstance(value, bool) or not isinstance(value, int | float):
        hint = (
            " give it a number first"
            if value is None
            else f" go on with one of: {', '.join(names_in(value)) or 'none'}"
        )
        raise InvalidValue(f"setting '{path}' is {value!r}, not a number;{hint}")
    return value


def is_whole(owner: Controller | Problem, path: str) -> bool:
    """Whether the setting at a path is declared as a whole number."""
    parent, _, name = path.rpartition(".")
    part: Any = content_at(owner, parent) if parent else owner
    return is_dataclass(part) and expects_whole_number(type(part), name)


@dataclass(frozen=True)
class Span:
    """Numbers from `low` to `high`, all equally likely at first.

    Args:
        low: the smallest number.
        high: the largest number.

    Raises:
        InvalidValue: an end that is not finite, or a low end that is not below the high end.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        _check(self, "Span")

    def number(self, share: float) -> float:
        """Return the number at `share` (0 to 1) of the way from low to high."""
        return _rounded(self.low + share * (self.high - self.low), self.low, self.high)


@dataclass(frozen=True)
class LogSpan:
    """Numbers of one sign whose logarithms are equally likely at first, for settings such as 0.01, 0.1 or 1.

    Args:
        low: the smallest number.
        high: the largest number.

    Raises:
        InvalidValue: an end that is not finite, a low end that is not below the high end, or ends of different sign.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        _check(self, "LogSpan")
        if self.low * self.high <= 0:
            raise InvalidValue(
                f"LogSpan({self.low!r}, {self.high!r}): both ends must have the same sign; use Span across zero"
            )

    def number(self, share: float) -> float:
        """Return the number at `share` (0 to 1) of the way from low to high."""
        value = math.copysign(
            math.exp(math.log(abs(self.low)) * (1 - share) + math.log(abs(self.high)) * share), self.low
        )
        return _rounded(value, self.low, self.high)


TuningSpans = Mapping[str, Span | LogSpan]


def check_tuning(tuning: Any, controllers: Mapping[str, Controller]) -> None:
    """Raise if a problem file's `tuning` is not {controller: {path: Span or LogSpan}} of controllers and settings that exist."""
    mistakes = Mistakes("tuning")
    if not isinstance(tuning, Mapping) or not all(isinstance(spans, Mapping) for spans in tuning.values()):
        mistakes.add("expected {'controller': {'deformation.gain': fpirhc.Span(low, high)}}")
        mistakes.raise_if_any()
    mistakes.unknown("controller", tuning, controllers)
    for name in (n for n in tuning if n in controllers):
        for path, span in tuning[name].items():
            if not isinstance(span, Span | LogSpan):
                mistakes.add(
                    f"controller '{name}', '{path}': expected Span(low, high) or LogSpan(low, high), got {span!r}"
                )
            with mistakes.caught(f"controller '{name}': "):
                current_setting(controllers[name], str(path))
    mistakes.raise_if_any()


def _check(span: Span | LogSpan, kind: str) -> None:
    numbers = all(finite_number(v) for v in (span.low, span.high))
    if not numbers or not span.low < span.high:
        raise InvalidValue(f"{kind}({span.low!r}, {span.high!r}): expected two finite numbers, the smaller one first")


def _rounded(value: float, low: float, high: float) -> float:
    return min(max(float(f"{value:.{_DIGITS}g}"), low), high)
