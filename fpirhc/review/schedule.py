"""Is a schedule of slots stable? It is, where its Floquet radius with ideal deformations is below 1."""

from __future__ import annotations

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict, decided
from fpirhc.task.problem import Problem

QUESTION = "Is the schedule of slots stable?"


def schedule_stable(problem: Problem, controller: Controller) -> Answer | None:
    """Return the Floquet radius of one period; None without slots.

    Gains of the wrong sign do not reach this question: the controller refuses them.
    """
    while controller.inner is not None:
        problem, controller = controller.inner_problem(problem), controller.inner
    if not hasattr(controller, "floquet"):
        return None
    try:
        floquet = controller.floquet(problem)
    except FpirhcError as error:
        return Answer(QUESTION, Verdict.UNKNOWN, str(error))
    if floquet.radius is None:
        return Answer(QUESTION, Verdict.UNKNOWN, f"no Floquet radius: {floquet.reason}", "Use a periodic schedule.")
    text = (
        f"near the set-point errors change by {floquet.radius:.3g} per period of {floquet.period:g} {problem.time_unit}"
    )
    text += ", with ideal deformations"
    change = "" if floquet.radius < 1 else "Change the slots' durations or rates; see floquet_radius."
    return Answer(
        QUESTION,
        decided(floquet.radius < 1),
        text,
        change,
        {"floquet_radius": floquet.radius, "period": floquet.period},
    )
