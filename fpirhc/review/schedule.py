"""Is a schedule of slots stable? By its Floquet radius, with ideal deformations."""

from __future__ import annotations

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict, decided
from fpirhc.task.problem import Problem

QUESTION = "Is the schedule of slots stable?"


def schedule_stable(problem: Problem, controller: Controller) -> Answer | None:
    """Return the radius of one period, whose gains of the wrong sign the controller has already refused; None without slots."""
    try:
        found = controller.floquet(problem)
    except FpirhcError as error:
        return Answer(QUESTION, Verdict.UNKNOWN, str(error))
    if found is None:
        return None
    if found.radius is None:
        return Answer(
            QUESTION, Verdict.UNKNOWN, f"no Floquet radius: {found.reason}", "Use a periodic schedule to know one."
        )
    text = f"near the set-point errors change by {found.radius:.3g} per period of {found.period:g} s, with ideal deformations"
    change = "" if found.radius < 1 else "Change the slots' durations or rates; see floquet_radius."
    return Answer(
        QUESTION, decided(found.radius < 1), text, change, {"floquet_radius": found.radius, "period": found.period}
    )
