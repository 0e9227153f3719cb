"""Settings of a controller by dotted path, and the ranges in which tuning searches for them, linear or logarithmic."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError, InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Finite
from fpirhc.symbolic.dotted import changed_at, content_at, mapped, names_in
from fpirhc.task.cases import WORDS, Cases, check_change, settable
from fpirhc.task.problem import Problem

Owner = TypeVar("Owner", Controller, Problem)
_DIGITS = 4  # of every number that is tried, so that a written number is exactly the tried one


def with_settings(owner: Owner, values: Mapping[str, float]) -> Owner:
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
        changed = changed_at(changed, path, value)
    return changed


def of_problem(path: str) -> bool:
    """Whether a path begins with a word of a case, see `Cases`."""
    return path.partition(".")[0] in {*WORDS, *(f.name for f in fields(Problem))}


def with_numbers(problem: Problem, values: Mapping[str, Any]) -> Problem:
    """Return a problem with other numbers at paths of a case."""
    if not values:
        return problem
    case, mistakes = Cases({"--set": values}), Mistakes("--set")
    for path in values:
        with mistakes.caught(f"'{path}': "):
            check_change(problem, values, path)
    mistakes.raise_if_any()
    return case.problem("--set", problem)


def is_own(controller: Controller, path: str) -> bool:
    """Whether a path begins with a field of the controller that it has: a number that problem and controller have is its own."""
    return getattr(mapped(controller, first := path.partition(".")[0]), first, None) is not None


def number_of_case(problem: Problem, path: str) -> float | None:
    """Return the number that a problem has at a path of a case; None where there is none, or no number."""
    word, _, name = path.partition(".")
    if word in WORDS:
        return settable(problem, word).get(name, (None,))[0]
    try:
        return current_setting(problem, path)
    except FpirhcError:
        return None  # 'group', 'reference', or a field that another case has made


def current_setting(owner: Controller | Problem, path: str) -> float:
    """Return the number at a path."""
    value = content_at(owner, path, "the problem" if isinstance(owner, Problem) else "the controller")
    if isinstance(value, bool) or not isinstance(value, int | float):
        mend = "give it a number first" if value is None else f"go on with: {', '.join(names_in(value)) or 'none'}"
        raise InvalidValue(f"setting '{path}' is {value!r}, not a number; {mend}")
    return value


@dataclass(frozen=True)
class Span(Checked):
    """Numbers from `low` to `high`, all equally likely at first.

    Args:
        low: the smallest number.
        high: the largest number.

    Raises:
        InvalidValue: an end that is not finite, or a low end that is not below the high end.
    """

    low: Finite
    high: Finite

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InvalidValue(f"{self}: expected the smaller number first")

    def number(self, share: float) -> float:
        """Return the number at `share` (0 to 1) of the way from low to high."""
        return min(max(float(f"{self._between(share):.{_DIGITS}g}"), self.low), self.high)

    def _between(self, share: float) -> float:
        return self.low + share * (self.high - self.low)


@dataclass(frozen=True)
class LogSpan(Span):
    """Numbers of one sign whose logarithms are equally likely at first, for settings such as 0.01, 0.1 or 1.

    Args:
        low: the smallest number.
        high: the largest number.

    Raises:
        InvalidValue: an end that is not finite, a low end that is not below the high end, or ends of different sign.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low * self.high <= 0:
            raise InvalidValue(f"{self}: both ends must have the same sign; use Span across zero")

    def _between(self, share: float) -> float:
        return math.copysign(abs(self.low) ** (1 - share) * abs(self.high) ** share, self.low)


TuningSpans = Mapping[str, Span]
