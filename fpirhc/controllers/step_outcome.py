"""What a gate keeps of a step: its results where they are finite, else everything as it was.

A sample may be finite and yet outside the domain of the model, such as a level of -2 mm below a square root, or a state for which
algebraic equations have no solution. The step is then not finite, and its cycle is skipped like that of a bad sample.

A step that is not finite for many cycles of good samples in a row may also be the fault of the memory, in which a bit has flipped.
One cycle is then tried with the memory of the start. Where that is finite the memory was at fault, and the controller begins anew.
Where it is not, the sample is at fault, and the memory stays as it was until the next trial.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.status import Status
from fpirhc.symbolic.expression import FINITE, Expression, expression
from fpirhc.symbolic.finite import every_finite, kept_if_finite
from fpirhc.symbolic.layout import Layout

FAILED = "not_finite"  # in the memory: steps in a row that were not finite, of samples that fit
PATIENCE = 10  # such steps before one is tried with the memory of the start


def outcome(
    memory_next: Expression,
    memory: Expression,
    command: Expression,
    trace: Expression,
    layout: Layout,
    ran: Expression,
    *,
    opaque: bool,
) -> tuple[Expression, Expression]:
    """Return (memory to keep, whether the step is fine): memory and command are finite, and no status says that something was not.

    Args:
        memory_next: of the next cycle.
        memory: as it was.
        command: of this cycle.
        trace: of this cycle.
        layout: of the trace.
        ran: whether the results are to be kept where they are fine.
        opaque: whether the step is a graph of calls.
    """
    said = expression(1.0) if "status" not in layout else trace[layout.slice("status")] != int(Status.NON_FINITE)
    if not opaque:
        fine = ca.logic_and(every_finite(ca.vertcat(memory_next, command)), said)
        return ca.if_else(ca.logic_and(ran, fine), memory_next, memory), fine
    good = ca.logic_and(ca.mmin(ca.fabs(command) <= FINITE), said)
    kept, finite = kept_if_finite(memory_next, memory, ca.logic_and(ran, good))
    return kept, ca.logic_and(finite, good)


def counted(failed: Expression, fits: Expression, fine: Expression) -> Expression:
    """Return the count of the next cycle: bad samples leave it, and after a trial it begins anew; NaN counts as none."""
    more = ca.if_else(failed < PATIENCE - 0.5, failed + 1, 0)
    return ca.if_else(fits, ca.if_else(fine, 0, more), ca.if_else(failed < PATIENCE + 0.5, failed, 0))


def is_trial(failed: Expression) -> Expression:
    """Return whether this cycle is tried with the memory of the start; a count that cannot be, after a flipped bit, is none."""
    return ca.fabs(failed - PATIENCE) < 0.5


def was_skipped(status: Expression) -> Expression:
    """Return whether a cycle of this status was skipped: its sample, its time or its step was not good."""
    bad = ca.logic_or(status == int(Status.BAD_SAMPLE), status == int(Status.NON_FINITE))
    return ca.logic_or(bad, status == int(Status.BAD_TIME))
