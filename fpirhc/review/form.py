"""Which form of the iteration a problem wants."""

from __future__ import annotations

from collections.abc import Callable

from fpirhc.deformation.base import Deformation
from fpirhc.describe import as_written
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.forms import INCREMENT, PLAIN, REFERENCED, forms_of
from fpirhc.task.problem import Problem

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
        return REFERENCED, "told of the dead time it leaks, and leaves an exact model alone"
    return REFERENCED, "it leaves an exact model alone whatever the period and the plant's drift"


def form_of(deformation: Deformation) -> str:
    """The form in use."""
    if deformation.mirror is not None:
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
    question = "Is it the form of the iteration that the problem wants?"
    form, why = recommended_form(problem)
    used = form_of(deformation)
    text = f"it is {used}; measurements speak for {form}, because {why}"
    if used == form:
        return Answer(question, Verdict.YES, f"it is {used}: {why}")
    proposed = forms_of(problem, deformation).get(form)
    against = "" if proposed is None else harm(proposed)
    if against and not harm(deformation):
        return Answer(question, Verdict.YES, f"{text}; but here {against}, and the form in use does no harm")
    if against:
        change = "Keep the form that a comparison shows to be better."
        return Answer(question, Verdict.UNKNOWN, f"{text}; but here {against}", change)
    change = "Try another form." if proposed is None else f"Try {as_written(proposed)}."
    return Answer(question, Verdict.UNKNOWN, text, change)
