"""All questions about a problem and its controllers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

from fpirhc.broken import attempted
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import checked, resolved
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.review.answer import Answer, Review, Verdict
from fpirhc.review.chatter import chatter_small
from fpirhc.review.commands import commands_inside
from fpirhc.review.convergence import box_converges, converges
from fpirhc.review.discretisation import discretisation_follows
from fpirhc.review.form import right_form
from fpirhc.review.gain import gain_admissible, gain_of_target
from fpirhc.review.gain_advice import gain_advice
from fpirhc.review.grid import ReviewGrid, review_grid
from fpirhc.review.horizon import horizon_long_enough
from fpirhc.review.inverse import inverse_exists
from fpirhc.review.loops import Loops, loops_along
from fpirhc.review.maps import largest_product
from fpirhc.review.margins import margins_enough
from fpirhc.review.neighbourhood import spectrum_near
from fpirhc.review.nominal_runs import NominalRuns
from fpirhc.review.null_test import leaves_right_model_alone
from fpirhc.review.orders import relative_orders
from fpirhc.review.pays import pays
from fpirhc.review.planned import is_planned
from fpirhc.review.question import Case, ControllerQuestion, ProblemQuestion, known_questions
from fpirhc.review.rates import rates_inside
from fpirhc.review.schedule import schedule_stable
from fpirhc.review.signs import one_sign
from fpirhc.review.slew import range_enough, slew_enough
from fpirhc.review.speed import bears_lag, fast_enough
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
    first = (well_posed, relative_orders, inverse_exists, commands_inside, discretisation_follows, horizon_long_enough)
    general = _answers((*first, *(question.ask for question in known_questions(ProblemQuestion))), grid)
    runs = NominalRuns(grid.problem)
    answers = {name: _of(grid, one, general, runs) for name, one in controllers.items()}
    return Review(tuple(general), answers, mismatch)


def _asked(ask: Callable[..., Answer | None], *about: object) -> Answer | None:
    """The answer to a question; unknown where asking it breaks, under the name of its function."""
    broken: list[str] = []
    answer = attempted("the answer", ask, *about, broken=broken)
    if not broken:
        return answer
    name = getattr(ask, "__name__", type(ask).__name__).strip("_").replace("_", " ")
    return Answer(f"{name.capitalize()}?", Verdict.UNKNOWN, broken[0])


def _answers(questions: Iterable[Callable[..., Answer | None]], *about: object) -> list[Answer]:
    """The answers to those questions that have one."""
    answers = (_asked(question, *about) for question in questions)
    return [answer for answer in answers if answer is not None]


def predict(problem: Problem, controller: Controller) -> Answer:
    """Return the verdict alone: whether the deformation of a controller converges on the plant with its exact parameters.

    Raises:
        NotInvertible: see `review`.
        FpirhcError: every error that the controller raises about the problem.
    """
    grid = review_grid(problem, 0.0, 0)
    own = replace(grid, draws=grid.draws[:1])  # the box does not matter
    ready = resolved(own.problem, controller)
    general = _answers((well_posed, inverse_exists, commands_inside), own)
    loops = loops_along(own, ready)
    case = Case(own, ready, loops, NominalRuns(own.problem))
    if ready.deforms == "target":
        return converges(own, ready, loops, _doubts(_doubtful(case)))
    suited = [*_speed_and_range(own, ready, loops), *_doubtful(case), free_of_two_cycles(case)]
    return converges(own, ready, loops, _doubts([*general, *suited]))


def _of(grid: ReviewGrid, controller: Controller, general: list[Answer], runs: NominalRuns) -> tuple[Answer, ...]:
    try:
        if grid.real is not None or grid.problem.plant.outputs:
            checked(grid.real or grid.problem, controller)
        ready = resolved(grid.problem, controller)
        ready.check(grid.problem)
    except FpirhcError as error:
        return (Answer("Does the controller fit the problem?", Verdict.NO, str(error)),)
    broken: list[str] = []
    schedule = _asked(schedule_stable, grid.problem, ready)
    if schedule is not None:
        return (schedule,)
    loops = attempted("the linear loop", loops_along, grid, ready, broken=broken)
    if loops is None:
        return (Answer("Is there a linear loop along the reference?", Verdict.UNKNOWN, broken[0]),)
    case = Case(grid, ready, loops, runs)
    discrete = _of_target if ready.deforms == "target" else _of_map
    inner = (
        attempted("the answers about the map", discrete, case, general, broken=broken)
        if ready.deformation.adapts
        else []
    )
    if inner is None:
        inner = [Answer("Does the iteration converge?", Verdict.UNKNOWN, broken[0])]
    outer = _answers((_rates, _zero_dynamics, _margins), case)
    return (*inner, *outer, *_more(case))


def _rates(case: Case) -> Answer | None:
    return rates_inside(case.grid, case.controller, case.loops)


def _zero_dynamics(case: Case) -> Answer | None:
    return zero_dynamics(case.problem, zero_dynamics_rate(case.grid), is_planned(case.controller), case.loops)


def _margins(case: Case) -> Answer | None:
    adapts, planned = case.controller.deformation.adapts, is_planned(case.controller)
    return margins_enough(case.problem, case.loops, adapts=adapts, planned=planned, learner=case.controller.learns)


def _more(case: Case) -> list[Answer]:
    """Answers to the questions that are found by discovery."""
    questions = (q for q in known_questions(ControllerQuestion) if _concerns(q, case.controller))
    return _answers((question.ask for question in questions if not question.doubts), case)


def _doubtful(case: Case) -> list[Answer]:
    """Answers whose no speaks against convergence."""
    questions = (q for q in known_questions(ControllerQuestion) if q.doubts and _concerns(q, case.controller))
    return _answers((question.ask for question in questions), case)


def _concerns(question: ControllerQuestion, controller: Controller) -> bool:
    """Whether a question is asked about a controller."""
    adapts = controller.deformation.adapts
    return not question.adaptive or (adapts and (question.of_targets or controller.deforms != "target"))


def _of_target(case: Case, general: list[Answer]) -> list[Answer]:
    """Answers about a map on targets: those of its linear loop. The gains of other questions are those of responses."""
    del general
    doubtful = _doubtful(case)
    verdict = converges(case.grid, case.controller, case.loops, _doubts(doubtful))
    null = _asked(leaves_right_model_alone, case)
    gain = _asked(gain_of_target, case)
    return [
        answer
        for answer in (verdict, box_converges(case.grid, case.loops), gain, *doubtful, null)
        if answer is not None
    ]


def _of_map(case: Case, general: list[Answer]) -> list[Answer]:
    grid, controller, loops, believed = case.grid, case.controller, case.loops, case.believed
    deformation = controller.deformation
    try:
        own, boxed = (spectrum_near(grid, believed, draws, near=False) for draws in (grid.draws[:1], grid.draws))
    except InvalidValue as error:
        return [Answer("Do the eigenvalues of the response Jacobian have one sign?", Verdict.UNKNOWN, str(error))]
    limit = largest_product(grid.problem, deformation, own.eigenvalues)
    null = _asked(leaves_right_model_alone, case)
    two_cycles = _asked(free_of_two_cycles, case)
    suited = [*_speed_and_range(grid, controller, loops), *_doubtful(case)]
    answers = (
        _asked(converges, grid, controller, loops, _doubts([*general, *suited, two_cycles])),
        _asked(box_converges, grid, loops),
        _asked(one_sign, own, boxed),
        _asked(gain_admissible, deformation, own, boxed, limit, gain_advice(case, boxed, null)),
        *suited,
        _asked(fast_enough, case, own),
        _asked(bears_lag, grid, controller, own),
        two_cycles,
        _asked(chatter_small, grid, controller),
        _asked(right_form, grid.problem, deformation, case.harm),
        _asked(pays, case),
        null,
    )
    return [answer for answer in answers if answer is not None]


def _speed_and_range(grid: ReviewGrid, controller: Controller, loops: Loops) -> list[Answer]:
    deformation, believed = controller.deformation, controller.plant_model(grid.problem).parameters(grid.problem.plant)
    ideal = loops.ideal if is_planned(controller) else None
    answers = (
        _asked(slew_enough, grid, deformation, believed, ideal),
        _asked(range_enough, grid, deformation, believed),
    )
    return [answer for answer in answers if answer is not None]


def _doubts(answers: Sequence[Answer | None]) -> list[str]:
    return [f"'{a.question}' is answered no" for a in answers if a is not None and a.verdict == Verdict.NO]
