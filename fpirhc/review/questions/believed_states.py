"""Do the errors of believed states decay? Where no measurement corrects them, they must do so by themselves.

The linear loops of a review have every state measured. So this is the only answer that knows the observer.
"""

from __future__ import annotations

from fpirhc.controllers.observed import FreeErrors, free_errors
from fpirhc.errors import NotSupported
from fpirhc.review.answer import Answer, decided
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import ProblemQuestion
from fpirhc.task.problem import Problem

TEXT = "Are the believed states right after a while?"


def right_after_a_while(grid: ReviewGrid) -> Answer | None:
    """Return which errors no measurement corrects, and their slowest pole; None where every state is measured or estimated."""
    problem = grid.problem
    believed = problem.sensing.believed(problem.plant)
    if not believed:
        return None
    try:
        free = free_errors(problem)
    except NotSupported:
        return None
    measured = ", ".join(problem.sensing.measures(problem.plant))
    if not free.states:
        return Answer(
            TEXT, decided(good=True), f"all errors of {', '.join(believed)} show in {measured}, which corrects them"
        )
    text = f"no measurement ({measured}) corrects the errors of {', '.join(free.states)}; {_motion(problem, free)}"
    change = "" if free.decays else f"Measure {free.states[0]}, or a quantity that depends on it."
    return Answer(TEXT, decided(free.decays), text, change, {"pole": free.pole})


def _motion(problem: Problem, free: FreeErrors) -> str:
    if free.decays:
        return f"they decay by themselves, with a time constant of {-1 / free.pole:.3g} {problem.time_unit} or less"
    return f"they do not decay by themselves (pole {free.pole:.3g} {problem.rate_unit})"


QUESTION = ProblemQuestion(right_after_a_while, order=20)
