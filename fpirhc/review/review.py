"""All questions about a problem and its controllers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import any_gain, checked
from fpirhc.controllers.contract import resolved, with_lateness
from fpirhc.errors import FpirhcError
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.review.grid import ReviewGrid, review_grid
from fpirhc.review.prediction import NominalRuns
from fpirhc.review.question import (
    Answer,
    Case,
    ControllerQuestion,
    ProblemQuestion,
    Review,
    Verdict,
    asked,
    decided,
    known_questions,
)
from fpirhc.review.questions.convergence import converges
from fpirhc.simulation.model_as_plant import behind_stated_lag
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.symbolic.evaluate import attempted
from fpirhc.task.problem import Problem


@checked_call
def review(problem: Problem, controllers: Mapping[str, Controller], *, mismatch: float, seed: Seed) -> Review:
    """Return the answers to all questions that can be answered before a run.

    Args:
        problem: the problem.
        controllers: the controllers by name.
        mismatch: range of the exact parameters, percent, see `fpirhc.plant.plant`; the box spans the plants
            between this range and the model too.
        seed: of the draws from the box.

    Raises:
        InvalidValue: a mismatch outside [0, 100).
        InvalidProblem: a range that leaves physical bounds.
        NotInvertible: the inputs and the controlled coordinates differ in number.
    """
    controllers = {name: with_lateness(problem, one) for name, one in controllers.items()}
    grid = review_grid(behind_stated_lag(problem), mismatch, seed)
    grid = replace(grid, states_dead_time=problem.moves.states_dead_time)  # behind its lag the model stands for a body
    general = _present(asked(question, grid) for question in known_questions(ProblemQuestion))
    runs = NominalRuns(grid.problem)
    with compiled_plans():
        answers = {name: _of(grid, one, general, runs) for name, one in controllers.items()}
    return Review(general, answers, mismatch)


def predict(problem: Problem, controller: Controller) -> Answer:
    """Return the verdict alone: whether the deformation of a controller converges on the plant with its exact parameters."""
    controller = with_lateness(problem, controller)
    grid = review_grid(behind_stated_lag(problem), 0.0, 0)
    grid = replace(grid, draws=grid.draws[:1])  # the box does not matter
    ready = resolved(grid.problem, controller)
    general = _present(asked(question, grid) for question in known_questions(ProblemQuestion) if question.doubts)
    case = Case(grid, ready, NominalRuns(grid.problem), general)
    return converges(grid, ready, case.loops, case.doubts)


def _of(grid: ReviewGrid, controller: Controller, general: tuple[Answer, ...], runs: NominalRuns) -> tuple[Answer, ...]:
    try:
        with any_gain():
            checked(grid.real or grid.problem, controller)
        ready = resolved(grid.problem, controller)
        ready.check(grid.problem)
    except FpirhcError as error:
        return (Answer("Does the controller fit the problem?", Verdict.NO, str(error)),)
    schedule = schedule_stable(grid.problem, ready)
    if schedule is not None:
        return (schedule,)
    case, broken = Case(grid, ready, runs, general), list[str]()
    if attempted("the linear loop", lambda: case.loops, broken=broken) is None:
        return (Answer("Is there a linear loop along the reference?", Verdict.UNKNOWN, broken[0]),)
    return _present(case.answer(question) for question in known_questions(ControllerQuestion))


def _present(answers: Iterable[Answer | None]) -> tuple[Answer, ...]:
    return tuple(answer for answer in answers if answer is not None)


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
        change = "" if floquet.period else "Use a periodic schedule."
        return Answer(QUESTION, Verdict.UNKNOWN, f"no Floquet radius: {floquet.reason}", change)
    text = (
        f"near the set-point errors change by {floquet.radius:.3g} per period of {floquet.period:g} {problem.time_unit}"
    )
    text += ", with ideal deformations"
    change = "Change the slots' durations or rates; see floquet_radius."
    return Answer(
        QUESTION,
        decided(floquet.radius < 1),
        text,
        change,
        {"floquet_radius": floquet.radius, "period": floquet.period},
    )
