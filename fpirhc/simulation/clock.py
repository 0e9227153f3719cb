"""The time of a machine's steps: whether it can follow that of the step before, missed cycles, and how long steps take.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import casadi as ca

from fpirhc.controllers.gate import AGAIN
from fpirhc.errors import InvalidValue
from fpirhc.status import Status
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import FINITE, Signals, nan_where
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem

# In the memory: the last time that was believed, or is expected; the last one that was given; and times in a row that are a period
# apart but do not follow the believed one.
MEMORY = Signal("clock", ("before", "heard", "regular"), start=(-FINITE, -FINITE, 0.0))
CLOCK = "_clock"  # signal of the believed time; NaN where it is none, and AGAIN where it repeats
LONGEST = 1e5  # periods between two steps
_RESOLVED = 2.0**42  # periods from zero within which a period is resolved to a thousandth
_PATIENCE = 20
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Clock = Callable[[], float]
_PER_OCTAVE, _LOWEST, _HIGHEST = 32, -30, 10
_SHOWN = 99.9  # the percentile that is shown


def clock_block(problem: Problem) -> Block:
    """Return the block (time) -> the time where it may be believed, else NaN; and the memory of the clock."""
    period = float(problem.period)

    def step(s: Signals) -> dict[str, Expression]:
        time, (before, heard, regular) = s.time, ca.vertsplit(getattr(s, MEMORY.name))
        resolved = ca.fabs(time) <= _RESOLVED * period
        first = ca.logic_not(before > -FINITE / 2)  # also of a memory that is not finite
        passed = time - before
        follows = ca.logic_and(passed >= period / 2, passed <= LONGEST * period)
        apart = ca.fabs(time - heard - period) <= period / 2
        count = ca.if_else(apart, regular + 1, 0)
        believed = ca.logic_and(resolved, ca.logic_or(ca.logic_or(first, follows), count > _PATIENCE - 0.5))
        repeats = ca.fabs(passed) < period / 2
        again = ca.logic_and(repeats, ca.logic_not(believed))
        expected = ca.if_else(ca.logic_or(first, repeats), before, before + period)
        return {
            CLOCK: ca.if_else(again, AGAIN, time) + nan_where(ca.logic_not(ca.logic_or(believed, again))),
            f"{MEMORY.name}_next": ca.vertcat(
                ca.if_else(believed, time, ca.if_else(expected > -FINITE, expected, -FINITE)),
                ca.if_else(ca.fabs(time) <= FINITE, time, -FINITE),
                ca.if_else(believed, 0, ca.if_else(count < _PATIENCE, count, 0)),
            ),
        }

    return Block("clock", Layout((problem.plant.time,)), Layout((Signal(CLOCK),)), step, Layout((MEMORY,)))


def clock_status_block(problem: Problem, before: str, after: str) -> Block:
    """Return the block (time, believed time, status) -> status: BAD_TIME for a cycle skipped for a finite time."""
    reads = Layout((problem.plant.time, Signal(CLOCK), scalar(before)))

    def step(s: Signals) -> dict[str, Expression]:
        refused = ca.logic_and(ca.fabs(s.time) <= FINITE, ca.logic_not(ca.fabs(getattr(s, CLOCK)) <= FINITE))
        return {after: ca.if_else(refused, int(Status.BAD_TIME), getattr(s, before))}

    return Block("clock_status", reads, Layout((scalar(after),)), step)


def missed_cycles(time: float, before: float, period: float) -> int:
    """Return how many cycles lie between two steps; 0 where the later one is the next cycle, or cannot follow the other.

    The sample of a missed cycle is missing. The command of the last step went on acting in it, as in every cycle that is skipped.

    Args:
        before: time of the step before it, as the clock remembers it; -FINITE: there was none.
    """
    cycles = (time - before) / period
    return round(cycles) - 1 if before > -FINITE / 2 and 1.5 <= cycles <= LONGEST else 0


class Deadline:
    """Times of steps, from entering to leaving: the late ones are counted, and nothing is kept of the others.

    Durations are counted in classes whose ends are in the ratio 2^(1/32), from 2^-30 s to 2^10 s, so that a percentile is known
    to 2.2 % in constant memory, however long a machine runs.

    Attributes:
        limit: the deadline, s.
        cycles: number of steps.
        late: number of steps beyond the deadline.
        worst: longest step, s; 0 before the first.
        last: last step, s.
    """

    def __init__(self, limit: float, clock: Clock) -> None:
        """Begin to count. `clock`: function that returns the time, s."""
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

    def percentile(self, percent: float = _SHOWN) -> float:
        """Return a duration within which at least this share of the steps ended, s: the upper end of its class, at most `worst`.

        `percent`: from 0 to 100.
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
