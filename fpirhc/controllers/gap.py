"""The gap counter of a gate: how many cycles went by without a sample, and what the next sample finds.

    sample missing      the count goes up, and what is a memory of the passing time goes on: queues, filters, observers
    the next sample     is told the gap; estimators and queues are moved over it (`fpirhc.symbolic.gap`); status BRIDGED
    after a long gap    estimators begin anew from this sample with their derivatives, and what was learned is held until their
                        windows hold samples of now alone, as after a start; status SETTLING

A gap is long beyond a stated number of cycles. Before the first sample nothing has begun, so there is no gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca

from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.expression import FINITE, Signals, expression
from fpirhc.symbolic.gap import GAP, LONG, SETTLING
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.task.problem import Problem

AGAIN = 100 * FINITE  # time of a cycle that is given once more: no number that fits, and no cycle that is missing
BRIDGED = 50  # cycles: the longest gap that is bridged, where nobody states another
MISSING = Signal(
    "missing_cycles", start=(-1.0,)
)  # in the memory: cycles since the last sample; -1 before the first one
_STILL = Signal("still_settling")  # in the memory: cycles for which what was learned is held


Counts: TypeAlias = dict[str, Expression]


@dataclass(frozen=True)
class Gap:
    """What a gate counts.

    Args:
        bridged: number of missing cycles up to which a gap is bridged.
        settles: number of samples after a long gap that a response needs: that of the start, and what a filter forgets in.
    """

    bridged: int
    settles: float

    @property
    def memory(self) -> tuple[Signal, ...]:
        """Cycles since the last sample, and cycles for which what was learned is held."""
        return (MISSING, _STILL)

    def counts(self, s: Signals, *, trusted: bool) -> Counts:
        """Return the remembered counts; those that a memory cannot have held are those of the start.

        Args:
            s: signals of the cycle.
            trusted: whether nobody else can have written the memory.
        """
        missing, still = getattr(s, MISSING.name), getattr(s, _STILL.name)
        if trusted:
            return {MISSING.name: missing, _STILL.name: still}
        good = ca.logic_and(ca.fabs(missing) <= self.bridged + 1, ca.fabs(still) <= self.settles)
        return {MISSING.name: ca.if_else(good, missing, -1), _STILL.name: ca.if_else(good, still, 0)}

    def passes(self, counts: Counts, time: Expression) -> Expression:
        """Return whether a cycle without a sample is one of a gap: there has been a sample, and the cycle is a new one."""
        return ca.logic_and(counts[MISSING.name] > -0.5, ca.logic_not(time >= AGAIN))

    def seen(self, counts: Counts) -> Counts:
        """Return what the step is told, by name of its signal."""
        missing = counts[MISSING.name]
        long = missing > self.bridged + 0.5
        settling = ca.if_else(long, self.settles, ca.fmax(counts[_STILL.name] - 1, 0)) if self.settles else 0.0
        return {GAP.name: ca.if_else(long, LONG, ca.fmax(missing, 0)), SETTLING.name: expression(settling)}

    def status(self, status: Expression, told: Counts) -> Expression:
        """Return the status of a cycle with a sample: that of the step, unless it is OK and a gap came before."""
        bridged = ca.if_else(told[GAP.name] > 0.5, int(Status.BRIDGED), status)
        gap = ca.if_else(told[SETTLING.name] > 0.5, int(Status.SETTLING), bridged)
        return ca.if_else(status == int(Status.OK), gap, status)

    def remembered(self, fits: Expression, passes: Expression, counts: Counts, told: Counts) -> Counts:
        """Return the counts one cycle later, by name."""
        missing = counts[MISSING.name]
        more = ca.if_else(passes, ca.fmin(missing + 1, self.bridged + 1), missing)
        still = ca.if_else(fits, told[SETTLING.name], counts[_STILL.name])
        return {MISSING.name: ca.if_else(fits, 0, more), _STILL.name: still}


def gap_of(problem: Problem, bridged: int) -> Gap:
    """Return the gap counter of a problem's steps.

    Args:
        problem: of the steps; where state and response are measured as they are, nothing settles.
        bridged: number of missing cycles up to which a gap is bridged.
    """
    if not problem.sensing.estimates:
        return Gap(bridged, 0.0)
    settling = problem.sensing.settling_cycles(problem.plant, problem.period)
    return Gap(bridged, float(problem.longest_warm_up + settling))


def across_gaps(step: Composite) -> Composite:
    """Return a controller's step as it is where samples may be lost."""
    lossy = step.bridged_if_any
    return step if lossy is None else lossy()
