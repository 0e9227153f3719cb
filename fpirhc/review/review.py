"""All questions about a problem and its controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import checked, resolved
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.fields.checked_call import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.review.answer import Answer, Review, Verdict
from fpirhc.review.chatter import chatter_small
from fpirhc.review.commands import commands_inside
from fpirhc.review.convergence import box_converges, converges
from fpirhc.review.discretisation import discretisation_follows
from fpirhc.review.form import right_form
from fpirhc.review.gain import gain_admissible
from fpirhc.review.grid import ReviewGrid, review_grid
from fpirhc.review.horizon import horizon_long_enough
from fpirhc.review.inverse import inverse_exists
from fpirhc.review.loops import Loops, loops_along
from fpirhc.review.maps import largest_product
from fpirhc.review.margins import margins_enough
from fpirhc.review.neighbourhood import spectrum_near
from fpirhc.review.nominal_runs import NominalRuns
from fpirhc.review.of_order_zero import controls_order_zero, review_of_order_zero
from fpirhc.review.orders import relative_orders
from fpirhc.review.pays import pays
from fpirhc.review.question import Case, ControllerQuestion, ProblemQuestion, known_questions
from fpirhc.review.rates import rates_inside
from fpirhc.review.reach import range_enough
from fpirhc.review.schedule import schedule_stable
from fpirhc.review.signs import one_sign
from fpirhc.review.slew import slew_enough
from fpirhc.review.speed import bears_lag, fast_enough
from fpirhc.review.stand_in import is_planned
from fpirhc.review.two_cycles import free_of_two_cycles
from fpirhc.review.well_posed import well_posed
from fpirhc.review.zero_dynamics import zero_dynamics, zero_dynamics_rate
from fpirhc.task.problem import Problem


@checked_call
def review(problem: Problem, controllers: Mapping[str, Controller], *, mismatch: float, seed: Seed) -> Review:
    """Return the answers to all questions that can be answered before a run.

    Args:
        problem: the problem.
        controllers: the controllers by name.
        mismatch: range of the exact parameters, percent, see `fpirhc.plant.mismatch`; the box spans the plants
            between this range and the model too.
        seed: of the draws from the box.

    Raises:
        InvalidValue: a mismatch outside [0, 100).
        InvalidProblem: a range that leaves physical bounds.
        NotInvertible: the inputs and the controlled coordinates differ in number.
    """
    grid = review_grid(problem, mismatch, seed)
    if controls_order_zero(grid):
        return review_of_order_zero(grid, controllers)
    general = [well_posed(grid), relative_orders(grid), inverse_exists(grid), commands_inside(grid)]
    reach = horizon_long_enough(grid)
    more = (question.ask(grid) for question in known_questions(ProblemQuestion))
    general += [answer for answer in (reach, discretisation_follows(grid), *more) if answer is not None]
    runs = NominalRuns(grid.problem)
    answers = {name: _of(grid, one, general, runs) for name, one in controllers.items()}
    return Review(tuple(general), answers, mismatch)


def predict(problem: Problem, controller: Controller) -> Answer:
    """Return the verdict alone: whether the deformation of a controller converges on the plant with its exact parameters.

    Raises:
        NotInvertible: see `review`.
        FpirhcError: every error that the controller raises about the problem.
    """
    grid = review_grid(problem, 0.0, 0)
    own = replace(grid, draws=grid.draws[:1])  # the box does not matter
    ready = resolved(own.problem, controller)
    general = [well_posed(own), inverse_exists(own), commands_inside(own)]
    loops = loops_along(own, ready)
    case = Case(own, ready, loops, NominalRuns(own.problem))
    if ready.deforms_target:
        return converges(own, ready, loops, _doubts(_doubtful(case)))
    suited = [*_speed_and_range(own, ready, loops), *_doubtful(case), free_of_two_cycles(own, ready, loops)]
    return converges(own, ready, loops, _doubts([*general, *suited]))


def _of(grid: ReviewGrid, controller: Controller, general: list[Answer], runs: NominalRuns) -> tuple[Answer, ...]:
    try:
        if grid.real is not None or grid.problem.plant.outputs:
            checked(grid.real or grid.problem, controller)
        ready = resolved(grid.problem, controller)
        ready.check(grid.problem)
    except FpirhcError as error:
        return (Answer("Does the controller fit the problem?", Verdict.NO, str(error), "See the message."),)
    schedule = schedule_stable(grid.problem, ready)
    if schedule is not None:
        return (schedule,)
    loops = loops_along(grid, ready)
    still = zero_dynamics(grid.problem, zero_dynamics_rate(grid), is_planned(ready), loops)
    outer = [rates_inside(grid, ready, loops), still]
    case = Case(grid, ready, loops, runs)
    of_map = _of_target if ready.deforms_target else _of_map
    inner = of_map(case, general) if ready.deformation.adapts else []
    return (*inner, *outer, margins_enough(grid.problem, loops, adapts=ready.deformation.adapts), *_more(case))


def _more(case: Case) -> list[Answer]:
    """Answers to the questions that are found by discovery."""
    questions = (q for q in known_questions(ControllerQuestion) if _concerns(q, case.controller))
    answers = (question.ask(case) for question in questions if not question.doubts)
    return [answer for answer in answers if answer is not None]


def _doubtful(case: Case) -> list[Answer]:
    """Answers whose no speaks against convergence."""
    answers = (q.ask(case) for q in known_questions(ControllerQuestion) if q.doubts and _concerns(q, case.controller))
    return [answer for answer in answers if answer is not None]


def _concerns(question: ControllerQuestion, controller: Controller) -> bool:
    """Whether a question is asked about a controller."""
    adapts = controller.deformation.adapts
    return not question.adaptive or (adapts and (question.of_targets or not controller.deforms_target))


def _of_target(case: Case, general: list[Answer]) -> list[Answer]:
    """Answers about a map on targets: those of its linear loop. The gains of other questions are those of responses."""
    del general
    covered = Answer(
        "Is the map's gain admissible?",
        Verdict.UNKNOWN,
        "not covered: the map acts on targets, and its limit depends on the slopes of the settled plant; the linear loop has those "
        "at the reference",
    )
    doubtful = _doubtful(case)
    verdict = converges(case.grid, case.controller, case.loops, _doubts(doubtful))
    return [verdict, box_converges(case.loops), covered, *doubtful]


def _of_map(case: Case, general: list[Answer]) -> list[Answer]:
    grid, controller, loops, believed = case.grid, case.controller, case.loops, case.believed
    deformation = controller.deformation
    try:
        own, boxed = (spectrum_near(grid, believed, draws, near=False) for draws in (grid.draws[:1], grid.draws))
    except InvalidValue as error:
        return [Answer("Do the eigenvalues of the response Jacobian have one sign?", Verdict.UNKNOWN, str(error))]
    limit = largest_product(grid.problem, deformation, own.eigenvalues)
    two_cycles = free_of_two_cycles(grid, controller, loops)
    suited = [*_speed_and_range(grid, controller, loops), *_doubtful(case)]
    verdict = converges(grid, controller, loops, _doubts([*general, *suited, two_cycles]))
    gains = [one_sign(own, boxed), gain_admissible(deformation, own, boxed, limit)]
    law = [fast_enough(grid, controller, own), bears_lag(grid, controller, own), two_cycles]
    known = [a for a in (*law, chatter_small(grid, controller)) if a is not None]
    form = right_form(grid.problem, deformation)
    return [verdict, box_converges(loops), *gains, *suited, *known, form, pays(case)]


def _speed_and_range(grid: ReviewGrid, controller: Controller, loops: Loops) -> list[Answer]:
    deformation, believed = controller.deformation, controller.parameters(grid.problem.plant)
    ideal = loops.ideal if is_planned(controller) else None
    answers = [slew_enough(grid, deformation, believed, ideal), range_enough(grid, deformation, believed)]
    return [a for a in answers if a is not None]


def _doubts(answers: Sequence[Answer | None]) -> list[str]:
    return [f"'{a.question}' is answered no" for a in answers if a is not None and a.verdict == Verdict.NO]
