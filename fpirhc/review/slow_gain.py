"""Is the gain large enough? The reason that a review gives, for the verdict on a run in which adaptation did not help."""

from __future__ import annotations

from fpirhc.broken import attempted
from fpirhc.controllers.base import Controller
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along
from fpirhc.review.neighbourhood import spectrum_near
from fpirhc.review.nominal_runs import NominalRuns
from fpirhc.review.question import Case
from fpirhc.review.questions.least_gain import plan_keeps_up
from fpirhc.review.speed import fast_enough
from fpirhc.task.problem import Problem


def slow_gain(problem: Problem, controller: Controller) -> str:
    """Return evidence and advice of a review that answers no to 'Does the iteration keep up?'; empty where it does not.

    Args:
        problem: of the run.
        controller: resolved.
    """
    if controller.deforms_target or not controller.deformation.adapts:
        return ""
    answer = attempted("the speed of the iteration", _answer, problem, controller, broken=[])
    if answer is None or answer.verdict is not Verdict.NO:
        return ""
    return f"Its gain is too small: {answer.evidence}. {answer.change}"


def _answer(problem: Problem, controller: Controller) -> Answer | None:
    grid = review_grid(problem, 0.0, 0)
    case = Case(grid, controller, loops_along(grid, controller), NominalRuns(grid.problem))
    own = spectrum_near(grid, case.believed, grid.draws[:1], near=False)
    return fast_enough(grid, controller, own) or plan_keeps_up(case)
