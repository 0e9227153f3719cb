"""How long the steps of a machine take, beside their deadline: the late ones are counted, and nothing is kept of the others.

Durations are counted in classes whose ends are in the ratio 2^(1/32), from 2^-30 s to 2^10 s, so that a percentile is known to
2.2 % in constant memory, however long a machine runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from fpirhc.errors import InvalidValue

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Clock = Callable[[], float]
_PER_OCTAVE, _LOWEST, _HIGHEST = 32, -30, 10
_SHOWN = 99.9  # the percentile that is shown


class Deadline:
    """Times of steps, from entering to leaving.

    Attributes:
        limit: the deadline, s.
        cycles: number of steps.
        late: number of steps beyond the deadline.
        worst: longest step, s; 0 before the first.
        last: last step, s.
    """

    def __init__(self, limit: float, clock: Clock) -> None:
        """Begin to count.

        Args:
            limit: s.
            clock: function that returns the time, s.

        Raises:
            InvalidValue: a limit that is not positive and finite.
        """
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0 < limit < math.inf:
            raise InvalidValue(
                f"Stepper(deadline={limit!r}): expected a positive number of seconds, such as the period"
            )
        self.limit, self._clock = float(limit), clock
        self.cycles = self.late = 0
        self.worst = self.last = self._begun = 0.0
        self._counts = [0] * ((_HIGHEST - _LOWEST) * _PER_OCTAVE + 1)

    def begin(self) -> None:
        """A step begins."""
        self._begun = self._clock()

    def end(self) -> None:
        """The step ends."""
        self.last = seconds = max(self._clock() - self._begun, 0.0)
        self.cycles += 1
        self.late += seconds > self.limit
        self.worst = max(self.worst, seconds)
        octaves = math.log2(seconds) - _LOWEST if seconds > 0 else 0.0
        self._counts[min(max(math.ceil(octaves * _PER_OCTAVE), 0), len(self._counts) - 1)] += 1

    def timed(self, step: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        """Return the step that is timed, also where it raises."""

        @wraps(step)
        def timed_step(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
            self.begin()
            try:
                return step(*arguments, **named)
            finally:
                self.end()

        return timed_step

    @property
    def was_late(self) -> bool:
        """Whether the last step was late."""
        return self.last > self.limit

    def percentile(self, percent: float = _SHOWN) -> float:
        """Return a duration within which at least this share of the steps ended, s: the upper end of its class, at most `worst`.

        Args:
            percent: from 0 to 100.
        """
        wanted, seen = self.cycles * percent / 100, 0
        for k, count in enumerate(self._counts[:-1]):  # the last class has no end
            seen += count
            if seen and seen >= wanted:
                return min(2.0 ** (k / _PER_OCTAVE + _LOWEST), self.worst)
        return self.worst

    def __str__(self) -> str:
        """The numbers in one line."""
        if not self.cycles:
            return f"deadline {_time(self.limit)}, no cycle yet"
        return (
            f"deadline {_time(self.limit)}: {self.late} of {self.cycles} cycles late, worst {_time(self.worst)}, "
            f"{_SHOWN:g} % within {_time(self.percentile())}"
        )


def _time(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} us"
