"""Values over time: samples that are held or joined by lines.

Whatever is called with a time and returns an expression is a course of values: `Samples`, a function such as
`lambda t: 290 + 5 * ca.sin(t)`, and a plain number, which is constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidShape, InvalidValue, nearest
from fpirhc.fields.checked import Checked
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.symbolic.expression import expression, graph, kind
from fpirhc.symbolic.layout import Expression

_HOLDS = ("zero", "linear")


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
        if self.hold not in _HOLDS:
            raise InvalidValue(f"Samples: hold {self.hold!r} is unknown.{nearest(str(self.hold), _HOLDS)}")
        times, values = (np.asarray(v, dtype=float) for v in (self.times, self.values))
        least = 1 if self.hold == "zero" else 2
        if times.ndim != 1 or times.size < least or values.shape != times.shape:
            raise InvalidShape(
                f"Samples: times have shape {times.shape} and values {values.shape}; expected one value per time, at least {least}"
            )
        if not (np.isfinite(times).all() and np.isfinite(values).all()) or np.any(np.diff(times) <= 0):
            raise InvalidValue("Samples: times and values must be finite, and the times must increase")

    @property
    def opaque(self) -> bool:
        """Whether the values are looked up, which scalar expressions cannot: they are."""
        return True

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


def is_opaque(course: Course) -> bool:
    """Whether a course needs operations that scalar expressions cannot."""
    return bool(getattr(course, "opaque", False))


def is_held(course: Course) -> bool:
    """Whether a course is constant between jumps, as a number and samples that are held are."""
    return not callable(course) or bool(getattr(course, "held", False))


def span_of(course: Course) -> tuple[float, float]:
    """First and last time for which a course has values; infinite where it has no end."""
    first, last = getattr(course, "span", (-math.inf, math.inf))
    return float(first), float(last)


def course_function(courses: Sequence[Course]) -> ca.Function:
    """Function time -> the value of every course, shape (number of courses,).

    Raises:
        InvalidProblem: a function of time raises, or does not return one scalar of the time.
    """
    matrix = kind(any(map(is_opaque, courses)))
    t = matrix.sym("t")
    values = [_value(course, t) for course in courses]
    return ca.Function("fpirhc_courses", [t], [ca.densify(ca.vertcat(*map(matrix, values)))], ["t"], ["values"])


def _value(course: Course, t: Expression) -> Expression:
    if not callable(course):
        return scalar_expression("signal", course)
    return scalar_expression("signal", called("signal", course, t), of=course, symbols=(t,))
