"""Outcomes of a control cycle or a solve, each with its remedy in words."""

from __future__ import annotations

from enum import IntEnum

STOPPED = "stopped"  # signal of a policy that stops: NaN where it does, which ends a run by this name


class Status(IntEnum):
    """Outcome of one control cycle or one solve; the numbers are those of saved runs, `severity` is the order."""

    OK = 0
    NOT_CONVERGED = 1
    INFEASIBLE = 2
    HELD = 3
    NON_FINITE = 4
    BAD_SAMPLE = 5
    RESTARTED = 6
    SOLVER_FAILED = 7
    SATURATED = 8
    BRIDGED = 10
    SETTLING = 11
    BAD_TIME = 12

    @property
    def severity(self) -> int:
        """Place in the order from best to worst."""
        return _BEST_TO_WORST.index(self)

    @property
    def remedy(self) -> str:
        """A sentence that states what happened and what to do next."""
        return _REMEDIES[self]


_BEST_TO_WORST = (
    Status.OK,
    Status.NOT_CONVERGED,
    Status.BRIDGED,
    Status.SETTLING,
    Status.BAD_SAMPLE,
    Status.BAD_TIME,
    Status.SATURATED,
    Status.INFEASIBLE,
    Status.HELD,
    Status.RESTARTED,
    Status.SOLVER_FAILED,
    Status.NON_FINITE,
)
_REMEDIES = {
    Status.OK: "solved: residuals are within the tolerance.",
    Status.NOT_CONVERGED: "the optimiser used all its iterations before its residual met the tolerance: "
    "allow more iterations, loosen the tolerance, or scale the cost.",
    Status.INFEASIBLE: "the plan violates a bound or the dynamics: check the initial state against the "
    "limits, soften state limits, or lengthen the horizon.",
    Status.HELD: "the optimiser failed and the stated policy replaced its plan: see the cycles counted here and the "
    "signals around them.",
    Status.NON_FINITE: "a signal became NaN or infinite, and the cycle was skipped: look at the first such signal of the run; the "
    "measurement is outside the model's domain, or the loop diverged.",
    Status.BAD_SAMPLE: "a measurement was lost, outside the range of its sensor, or out of date: the cycle was skipped, with the "
    "last command and every memory as it was; look at the sensor, or widen its range.",
    Status.BAD_TIME: "the time of the step cannot follow that of the last one: it repeats, goes back, or has another unit; the "
    "cycle was skipped. Give every step the time of its cycle.",
    Status.RESTARTED: "the memory was not finite and was forgotten: the controller began anew; look at where the memory is kept.",
    Status.SOLVER_FAILED: "a solver raised an error: the cycle was skipped, with the last command and every memory as it was; "
    "use FixedPointSolver(), or look at the measurement that the solver was given.",
    Status.SATURATED: "the command has been at a limit for longer than the stated time; integrals go no further into it: check the "
    "actuator, the sign of its gain, and whether the limits allow the task.",
    Status.BRIDGED: "cycles without a sample came before this one, lost or not called: the step was run once more for each; "
    "look at the sensor's connection, or at what delays the cycles.",
    Status.SETTLING: "more cycles than are bridged went by without a sample: windows were filled anew, on samples between those "
    "around the gap; look at the sensor's connection, or at what delays the cycles.",
}
