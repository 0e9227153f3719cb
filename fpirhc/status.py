"""Outcomes of a control cycle or a solve, each with its remedy in words."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """Outcome of one control cycle or one solve, ordered from best to worst."""

    OK = 0
    NOT_CONVERGED = 1
    INFEASIBLE = 2
    HELD = 3
    NON_FINITE = 4

    @property
    def remedy(self) -> str:
        """A sentence that states what happened and what to do next."""
        return _REMEDIES[self]


_REMEDIES = {
    Status.OK: "solved: residuals are within the tolerance.",
    Status.NOT_CONVERGED: "the optimiser used all its iterations before its residual met the tolerance: "
    "allow more iterations, loosen the tolerance, or scale the cost.",
    Status.INFEASIBLE: "the plan violates a bound or the dynamics: check the initial state against the "
    "limits, soften state limits, or lengthen the horizon.",
    Status.HELD: "the optimiser failed and the stated policy replaced its plan, or a slot's input had too little "
    "effect and the command was held: see the cycles counted here and the signals around them.",
    Status.NON_FINITE: "a signal became NaN or infinite: look at the first such signal of the run; the "
    "model is outside its domain or the loop diverged.",
}
