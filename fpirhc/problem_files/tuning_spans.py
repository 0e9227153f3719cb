"""Ranges in which tuning searches for a setting, linear or logarithmic, as a problem file states them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError, InvalidValue, Mistakes
from fpirhc.fields.real_number import finite_number
from fpirhc.problem_files.settings import current_setting

DIGITS = 4  # of every number that is tried, so that a written number is exactly the tried one


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
    """Raise if a problem file's `tuning` is not {controller: {path: Span or LogSpan}} of controllers and settings that exist.

    Raises:
        InvalidProblem: all mistakes together, with the nearest valid names.
    """
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
            try:
                current_setting(controllers[name], str(path))
            except FpirhcError as error:
                mistakes.add(f"controller '{name}': {error}")
    mistakes.raise_if_any()


def _check(span: Span | LogSpan, kind: str) -> None:
    numbers = all(finite_number(v) for v in (span.low, span.high))
    if not numbers or not span.low < span.high:
        raise InvalidValue(f"{kind}({span.low!r}, {span.high!r}): expected two finite numbers, the smaller one first")


def _rounded(value: float, low: float, high: float) -> float:
    return min(max(float(f"{value:.{DIGITS}g}"), low), high)
