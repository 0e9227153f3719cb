"""The clock of a machine: whether the time of a step can follow that of the step before.

    first step         any time that resolves a period, |t| <= 2^42 T
    next step          t - before >= T / 2, and at most 100 000 periods; beyond 1.5 T cycles were missed
    otherwise          the cycle is skipped, with the status BAD_TIME

A time in nanoseconds, one that repeats or goes back, and 1e18 s are no such times. A clock that was set is believed after twenty
times in a row that are a period apart, each from the one before. After a time that is no number, or absurd, the expected one goes
on by a period; a repeated one is the same cycle again.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.controllers.gap import AGAIN
from fpirhc.status import Status
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.finite import FINITE
from fpirhc.symbolic.functions import nan_where
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.problem import Problem

# In the memory: the last time that was believed, or is expected; the last one that was given; and times in a row that are a period
# apart but do not follow the believed one.
MEMORY = Signal("clock", ("before", "heard", "regular"), start=(-FINITE, -FINITE, 0.0))
CLOCK = "_clock"  # signal of the believed time; NaN where it is none, and AGAIN where it repeats
LONGEST = 1e5  # periods between two steps
_RESOLVED = 2.0**42  # periods from zero within which a period is resolved to a thousandth
_PATIENCE = 20


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
