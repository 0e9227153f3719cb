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
from fpirhc.symbolic.expression import Expression
from fpirhc.symbolic.finite import finite
from fpirhc.symbolic.layout import Layout

FAILED = "not_finite"  # in the memory: steps in a row that were not finite, of samples that fit
PATIENCE = 10  # such steps before one is tried with the memory of the start


def is_fine(memory: Expression, command: Expression, trace: Expression, layout: Layout, *, opaque: bool) -> Expression:
    """Return whether a step may be kept: memory and command are finite, and its status does not say that something was not.

    Args:
        memory: of the next cycle.
        command: of this one.
        trace: of this one.
        layout: of the trace.
        opaque: whether the step is a graph of calls.
    """
    fine = finite(ca.vertcat(memory, command), opaque=opaque)
    if "status" not in layout:
        return fine
    return ca.logic_and(fine, trace[layout.slice("status")] != int(Status.NON_FINITE))


def kept(fine: Expression, new: Expression, old: Expression, *, opaque: bool) -> Expression:
    """Return `new` where it is fine, else `old`; a graph copies one of the two whole, because its columns are long."""
    if not opaque:
        return ca.if_else(fine, new, old)
    one, other = ca.MX.sym("new", new.numel()), ca.MX.sym("old", new.numel())
    take = ca.Function("fpirhc_take_new", [one, other], [one]), ca.Function("fpirhc_take_old", [one, other], [other])
    return ca.Function.if_else("fpirhc_kept", *take)(fine, new, old)


def counted(failed: Expression, fits: Expression, fine: Expression) -> Expression:
    """Return the count of the next cycle: bad samples leave it, and after a trial it begins anew; NaN counts as none."""
    more = ca.if_else(failed < PATIENCE - 0.5, failed + 1, 0)
    return ca.if_else(fits, ca.if_else(fine, 0, more), ca.if_else(failed < PATIENCE + 0.5, failed, 0))


def is_trial(failed: Expression) -> Expression:
    """Return whether this cycle is tried with the memory of the start."""
    return failed > PATIENCE - 0.5


def was_skipped(status: Expression) -> Expression:
    """Return whether a cycle of this status was skipped: its sample, its time or its step was not good."""
    bad = ca.logic_or(status == int(Status.BAD_SAMPLE), status == int(Status.NON_FINITE))
    return ca.logic_or(bad, status == int(Status.BAD_TIME))
