"""Which form of the iteration a problem wants."""

from __future__ import annotations

from collections.abc import Callable

from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.deformation.wrappers.delayed import Increment
from fpirhc.describe import as_written
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import ControllerQuestion
from fpirhc.task.problem import Problem

FORM = "Is it the form of the iteration that the problem wants?"
LATE = 1.0  # cycles of an estimator's delay, beyond which what the model is wrong by is known too late


def recommended_form(problem: Problem) -> tuple[str, str]:
    """Return the form that the measurements of docs/which-form.md speak for, and why."""
    delay = problem.sensing.delay(problem.plant, problem.period)
    waits = bool(problem.dead_time.measurement or any(problem.dead_time.inputs.values()))
    if delay > LATE:
        why = f"the response is estimated {delay:.3g} cycles late"
        corrected = f"{why}, and the plain form corrects the lateness too"
        return (INCREMENT, f"{why} after a dead time, in which the plain form swings") if waits else (PLAIN, corrected)
    if waits:
        return REFERENCED, "with the dead time stated it leaks, and it leaves an exact model alone"
    return REFERENCED, "it leaves an exact model alone whatever the period and the plant's drift"


def form_of(deformation: Deformation) -> str:
    """The form in use."""
    if deformation.mirror.referenced:
        return REFERENCED
    if not deformation.iteration.slows_desired:
        return INCREMENT
    return PLAIN if deformation.iteration.pairing is None else "paired"


def right_form(problem: Problem, deformation: Deformation, harm: Callable[[Deformation], str]) -> Answer:
    """Whether the form in use is the recommended one, or runs speak against that one alone; advice, so never no.

    Args:
        problem: the problem.
        deformation: in use.
        harm: what runs show against a deformation; empty where it does no harm.
    """
    form, why = recommended_form(problem)
    used = form_of(deformation)
    text = f"it is {used}; measurements speak for {form}, because {why}"
    if used == form:
        return Answer(FORM, Verdict.YES, f"it is {used}: {why}")
    proposed = forms_of(problem, deformation).get(form)
    against = "" if proposed is None else harm(proposed)
    if against and not harm(deformation):
        return Answer(FORM, Verdict.YES, f"{text}; but here {against}, and the form in use does no harm")
    if against:
        change = "Keep the form that a comparison shows to be better."
        return Answer(FORM, Verdict.UNKNOWN, f"{text}; but here {against}", change)
    change = "Try another form." if proposed is None else f"Try {as_written(proposed)}."
    return Answer(FORM, Verdict.UNKNOWN, text, change)


PLAIN, INCREMENT, REFERENCED = "plain", "increment", "model-referenced"


def map_inside(deformation: Deformation) -> Deformation:
    """Return the map inside a form: without pairing, increment and model reference."""
    map_ = deformation
    while map_.inner is not None and (map_.iteration.pairing is not None or not map_.iteration.slows_desired):
        map_ = map_.inner
    return map_


def forms_of(problem: Problem, deformation: Deformation) -> dict[str, Deformation]:
    """Return the forms of the deformation's map by name, paired with the dead times of the problem.

    The plain form is left out where the response is late: it would need a pairing, which `Paired` gives.
    """
    map_, times = map_inside(deformation), problem.dead_time
    inputs = tuple(times.inputs.get(name, 0.0) / problem.period for name in problem.plant.inputs)
    measurement = times.measurement / problem.period
    cycles = inputs[0] if len(set(inputs)) == 1 else inputs
    sums = cycles + measurement if isinstance(cycles, float) else tuple(c + measurement for c in cycles)
    forms = {} if max(inputs) + measurement else {PLAIN: map_}
    return {
        **forms,
        INCREMENT: Increment(map_, cycles=sums),
        REFERENCED: ModelReferenced(map_, cycles=cycles or None, measurement=measurement),
    }


QUESTIONS = (
    ControllerQuestion(lambda case: right_form(case.problem, case.controller.deformation, case.harm), FORM, order=13),
)
