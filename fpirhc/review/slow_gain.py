"""Is it the gain? What a review says of one, for the verdict on a run in which adaptation did not help."""

from __future__ import annotations

from fpirhc.broken import attempted
from fpirhc.controllers.base import Controller
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along
from fpirhc.review.nominal_runs import NominalRuns
from fpirhc.review.question import Case
from fpirhc.review.questions.speed import fast_enough, plan_keeps_up
from fpirhc.review.recommended_gain import recommended_for
from fpirhc.task.problem import Problem


def reviewed_gain(problem: Problem, controller: Controller, *, grows: bool) -> str:
    """Return what a review says of the gain: the recommended one where errors grow, else whether it is too small, else nothing.

    Args:
        problem: of the run.
        controller: resolved.
        grows: whether the iteration is no contraction along the run.
    """
    if controller.deforms == "target" or not controller.deformation.adapts:
        return ""
    if grows:
        advice = recommended_for(problem, controller)
        return "" if advice is None else f"Its gain{' is too large' if advice.exceeded else ''}: {advice.text}."
    answer = attempted("the speed of the iteration", _answer, problem, controller, broken=[])
    if answer is None or answer.verdict is not Verdict.NO:
        return ""
    return f"Its gain is too small: {answer.evidence}. {answer.change}"


def _answer(problem: Problem, controller: Controller) -> Answer | None:
    grid = review_grid(problem, 0.0, 0)
    case = Case(grid, controller, loops_along(grid, controller), NominalRuns(grid.problem))
    return fast_enough(case) or plan_keeps_up(case)
