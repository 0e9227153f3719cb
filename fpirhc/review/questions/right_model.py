"""Does adaptation pay, does it leave a right model alone, and does its form suit the problem?

The null test: with the model as the plant adaptation must not do harm. Errors are predicted along the model's own run
(`prediction`); where a prediction does not say, runs do. The iteration takes whatever moves the response within a cycle for an
error of the model: a plant that is fast against the period drifts within it, and the plain form and `Increment` ask for less or
more than they should.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from fpirhc.deformation.base import Deformation, form_of
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.deformation.wrappers.delayed import Increment
from fpirhc.describe import as_written
from fpirhc.errors import FpirhcError
from fpirhc.plant.chain import controlled_unit
from fpirhc.plant.motion import known_exactly, with_space
from fpirhc.review.prediction import (
    TRIED,
    NominalRun,
    NominalRuns,
    ResponseErrors,
    errors_without_adaptation,
    null_errors,
    response_errors,
)
from fpirhc.review.question import Answer, Case, ControllerQuestion, Verdict, by_run, judged
from fpirhc.simulation.model_as_plant import with_believed_way
from fpirhc.simulation.trials import SLIGHT, ErrorPair
from fpirhc.summary import beside
from fpirhc.task.problem import Problem

FORM = "Does the form of the iteration suit the problem?"
SIMILAR = 1.1  # ratio of errors, up to which two forms are equally good
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


def right_form(
    problem: Problem,
    deformation: Deformation,
    harm: Callable[[Deformation], str],
    error: Callable[[Deformation], Mapping[str, Tried]] | None = None,
    counted: Callable[[Deformation], Mapping[str, Tried]] = lambda _: {},
) -> Answer:
    """Whether the form in use is the recommended one, or runs show that it is as good; advice, so never no.

    Args:
        harm: what runs show against a deformation; empty where it does no harm.
        error: errors of a run with a deformation by coordinate, none without a run; None: nothing is run.
        counted: the same where errors count, asked where a run speaks against the form in use; none where that run reaches so far.
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
        return Answer(FORM, Verdict.CAUTION, f"{text}; but here {against}", change)
    if proposed is None or error is None:
        change = "Try another form." if proposed is None else f"Try {as_written(proposed)}."
        return Answer(FORM, Verdict.UNKNOWN, text, change)
    both, when = (error(deformation), error(proposed)), f"a run of at most {TRIED} cycles"
    if not _as_good(*both) and (later := (counted(deformation), counted(proposed))) != ({}, {}):
        both, when = later, f"at most {TRIED} cycles in which errors count"
    text += _beside(*both, when, form)
    if _as_good(*both):
        return Answer(FORM, Verdict.YES, text)
    verdict = Verdict.CAUTION if math.isfinite(sum(_sizes(*both))) else Verdict.UNKNOWN
    return Answer(FORM, verdict, text, f"Try {as_written(proposed)}.")


def _sizes(own: Mapping[str, Tried], other: Mapping[str, Tried]) -> tuple[float, float]:
    """Both errors over all coordinates, as shares of the ranges; NaN without a run."""
    a, b = (math.hypot(*(one.share for one in tried.values())) if tried else math.nan for tried in (own, other))
    return a, b


def _as_good(own: Mapping[str, Tried], other: Mapping[str, Tried]) -> bool:
    """Whether runs show the first errors to be no larger than the second ones."""
    sizes = _sizes(own, other)
    return math.isfinite(sizes[0]) and sizes[0] <= SIMILAR * sizes[1]


def _beside(own: Mapping[str, Tried], other: Mapping[str, Tried], when: str, form: str) -> str:
    """Both errors of a coordinate that says what all of them together say; empty without runs."""
    sizes = _sizes(own, other)
    if not math.isfinite(sum(sizes)):
        return ""
    moved = {name: (own[name].share - other[name].share) * (sizes[0] - sizes[1]) for name in own}
    of = max(moved, key=lambda name: moved[name])
    return f"; in {when} the rms error of {of} is {own[of].size} as it is, {other[of].size} with the {form} form"


class Tried(NamedTuple):
    """The error of a coordinate in a run: as a share of its range, and as text with its unit."""

    share: float
    size: str


def _tried_error(case: Case, deformation: Deformation) -> Mapping[str, Tried]:
    """The errors of a run on the plant by coordinate; none without a run."""
    trial = case.trial(deformation)
    return _by_coordinate(None if isinstance(trial, str) else trial[0])


def _by_coordinate(pair: ErrorPair | None) -> Mapping[str, Tried]:
    every = {} if pair is None else pair.adapted
    return {n: Tried(e / max(pair.ranges[n], 1e-300), f"{e:.3g}{pair.unit(n)}") for n, e in every.items() if pair}


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


PAYS = "Does adaptation lower the response error?"
_HARM = 0.5  # share of the error without adaptation that adaptation may make of a model that is right

ROUNDING = 1e-6  # of the desired response's rms, below which a response error is rounding


def pays(case: Case) -> Answer:
    """Return the rms response errors without adaptation, with it, and with it on a right model, where every change does harm."""
    nominal = case.nominal
    if isinstance(nominal, str):
        return by_run(case, PAYS, nominal)
    without = rms(nominal, errors_without_adaptation(nominal))
    adapted = rms(nominal, response_errors(nominal))
    null = rms(nominal, null_errors(nominal))
    sizes = [_with_unit(case, e, nominal_size(nominal)) for e in (without, adapted, null)]
    error = "predicted rms response error while nothing is off the reference"
    text = f"{error}: {sizes[0]} without adaptation, {sizes[1]} with it, {sizes[2]} with a right model"
    numbers = {"without": without, "with": adapted, "null": null}
    if case.diverges:
        change = "The prediction leaves the outer loop out, and this one does not converge: see the convergence."
        return Answer(PAYS, Verdict.NO, f"{text}, but errors grow in every cycle", change, numbers)
    if max(without, adapted) <= ROUNDING * nominal_size(nominal) and not case.grid.elsewhere:
        return Answer(PAYS, Verdict.CAUTION, f"{text}: there is no error to lower", "", numbers)
    if not adapted < without:
        why = "for the exact values of the model's own parameters, which move nothing beside a reality"
        return by_run(case, PAYS, f"{text}, {why}") if case.grid.elsewhere else _no_gain(text, numbers)
    change = "Adaptation would do harm with a slightly better model: use a form that leaves a right model alone."
    return Answer(PAYS, Verdict.CAUTION if null > _HARM * without else Verdict.YES, text, change, numbers)


def _no_gain(text: str, numbers: dict[str, float]) -> Answer:
    """The answer where adaptation does not lower the predicted error."""
    if numbers["null"] <= _HARM * numbers["without"]:
        change = "Leave the deformation out: it leaves a right model alone, so another form does not help."
    else:
        change = "Leave the deformation out, or use a form that leaves a right model alone: this one changes more than is wrong."
    return Answer(PAYS, Verdict.NO, text, change, numbers)


def _with_unit(case: Case, error: float, scale: float) -> str:
    """A response error in its unit, where all controlled responses have one and the same."""
    size = beside(error, scale)
    return f"{size}{with_space(controlled_unit(case.problem.plant))}" if size == f"{error:.3g}" else size


def rms(nominal: NominalRun, errors: ResponseErrors) -> float:
    """Return the rms response error over all coordinates, from `measure_from` on; infinite where the errors do not stay finite."""
    first = min(round(nominal.problem.measure_from / nominal.problem.period), nominal.cycles - 1)
    with np.errstate(over="ignore", invalid="ignore"):
        size = float(np.sqrt(np.mean(np.sum(errors.error[first:] ** 2, axis=1))))
    return size if np.isfinite(size) else float("inf")


def nominal_size(nominal: NominalRun) -> float:
    """Return the rms of the desired response over all coordinates."""
    largest = float(np.abs(nominal.desired).max())  # a diverging model's own run would overflow when it is squared
    return largest * float(np.sqrt(np.mean(np.sum((nominal.desired / max(largest, 1e-300)) ** 2, axis=1))))


NULL_TEST = "Does adaptation leave a right model alone?"
_PRACTICAL = 100  # times, by which a period may be shortened in earnest
_SHORTER = 16  # times, of the interpolated run from which on the error falls in proportion to the period


def leaves_right_model_alone(case: Case) -> Answer:
    """Return the errors with the model as the plant, with adaptation and without."""
    # The model's own run, without simulation, knows nothing of a lag or a dead time that the deformation believes.
    foreseen = with_believed_way(case.problem, case.controller.deformation) is case.problem
    nominal = case.nominal if foreseen and not isinstance(case.nominal, str) else None
    predicted = None if nominal is None else rms(nominal, null_errors(nominal))
    numbers, text = {}, ""
    if nominal is not None and predicted is not None:
        numbers = {"response_without": 0.0, "response_with": predicted}
        size = _with_unit(case, predicted, nominal_size(nominal))
        text = f"predicted rms response error on a right model {size}, without adaptation 0; "
        if predicted <= ROUNDING * nominal_size(nominal):
            return Answer(NULL_TEST, Verdict.YES, f"{text}the request stays the desired response", "", numbers)
    ideal = case.loops.ideal
    if ideal is not None and ideal.radius >= 1:
        text += "the loop with the right model does not converge without adaptation"
        return Answer(NULL_TEST, Verdict.UNKNOWN, text, "See the rates.", numbers)
    try:
        runs = case.runs.null(case.controller)
        if runs.stuck and not (exact := _with_exact_values(case).null(case.controller)).stuck:
            runs, text = (
                exact,
                f"{text}the model has the exact values here, because with its own the command stands at a limit; ",
            )
    except FpirhcError as error:
        return Answer(NULL_TEST, Verdict.UNKNOWN, f"{text}no run of the model: {error}", "", numbers)
    worst = runs.worst
    numbers |= {"without": runs.without[worst], "with": runs.adapted[worst], "added": runs.added(worst)}
    text += f"{runs.text}{_left_out(case.problem)}"
    if runs.stuck:
        return Answer(
            NULL_TEST, Verdict.UNKNOWN, f"{text}; {runs.stuck}", "Run it where the commands are free.", numbers
        )
    learns = case.controller.learns
    spared = runs.fails and (learns or _cures_more(case, runs, nominal, predicted))
    verdict = judged(runs.passes, (runs,), spared=spared)
    if verdict == Verdict.YES:
        return Answer(NULL_TEST, verdict, text, "", numbers)
    if runs.fails and spared and not learns:
        text += ", less than what the wrong model costs without it"
    change, more = _remedy(case, runs, predicted)
    return Answer(NULL_TEST, verdict, text, change, numbers | more)


def _with_exact_values(case: Case) -> NominalRuns:
    """Runs of the model with the exact parameters, which can follow a reference that the wrong ones cannot."""
    own = case.problem.of_model
    return NominalRuns(replace(own, plant=known_exactly(own.plant)))


def _left_out(problem: Problem) -> str:
    """What the run of the model is without, in words; empty where nothing is left out."""
    noisy = any(sensor.noise is not None for sensor in problem.sensing.sensors.values())
    parts = ["noise"] * noisy + ["disturbances"] * bool(problem.disturbances)
    return f", without {' and '.join(parts)}" if parts else ""


def _cures_more(case: Case, runs: ErrorPair, nominal: NominalRun | None, predicted: float | None) -> bool:
    """Whether the wrong model makes a larger error without adaptation than adaptation makes of a right model.

    By runs on the plant; by the prediction where the plant is outside.
    """
    trial = case.trial(case.controller.deformation)
    real = None if isinstance(trial, str) else trial[0]
    if real is not None:
        return real.lowers and runs.adapted[runs.worst] < real.without[runs.worst]
    if nominal is None or predicted is None:
        return False
    return predicted < rms(nominal, errors_without_adaptation(nominal))


def _remedy(case: Case, runs: ErrorPair, predicted: float | None) -> tuple[str, dict[str, float]]:
    """Which form passes, by a run, and which period would do, by the prediction."""
    sentences, numbers = [], {}
    used = form_of(case.controller.deformation)
    others = 0
    for name, form in reversed(forms_of(case.problem, case.controller.deformation).items()):
        trial = case.trial(form) if name != used else "it is in use"
        others += not isinstance(trial, str)
        if not isinstance(trial, str) and not case.harm(form):
            null, worst = trial[1], runs.worst
            before, after = (f"{e[worst]:.3g}{null.unit(worst)}" for e in (null.without, null.adapted))
            run = f"in a run of at most {TRIED} cycles the rms error of {worst} is {before} without adaptation, {after} with it"
            sentences.append(f"The {name} form passes: {run}.")
            numbers["with_form"] = null.adapted[worst]
            break
    grows = bool(case.loops.loops) and case.loops.radii.max() >= 1
    period = None if predicted is None or grows else _period(case, runs, predicted)
    if period is not None and period < case.problem.period:
        shorter = case.problem.period / period
        text = (
            f"The form in use needs a period about {shorter:.2g} times shorter, {period:.2g} {case.problem.time_unit}."
        )
        sentences.append(text if shorter <= _PRACTICAL else "No practical period would do for the form in use.")
        numbers["period"] = period
    if not sentences:
        sentences.append(
            "No form does better than none: leave the deformation out, or choose other controlled coordinates."
            if others
            else "Change the gain, or leave the deformation out."
        )
    return " ".join(sentences), numbers


def _period(case: Case, runs: ErrorPair, predicted: float) -> float | None:
    """The period with which the predicted response error is as small as the null test asks for.

    The prediction leaves the outer loop out, and the error that adaptation adds to the coordinates is taken to be proportional to
    the response error. From a period `_SHORTER` times shorter on, the response error is taken to fall in proportion to it.
    """
    nominal, added = case.nominal, runs.added(runs.worst)
    if isinstance(nominal, str) or not math.isfinite(added):
        return None
    faster = _faster(nominal.null, _SHORTER)
    error = rms(faster, null_errors(faster))
    share = predicted * SLIGHT / added / error
    return min(case.problem.period, case.problem.period / _SHORTER * share)


def _faster(nominal: NominalRun, share: int) -> NominalRun:
    """The run at a period `share` times shorter, interpolated."""
    coarse = np.arange(nominal.cycles + 1)
    fine = np.arange(nominal.cycles * share + 1) / share
    states = np.column_stack([np.interp(fine, coarse, column) for column in nominal.states.T])
    desired = np.column_stack([np.interp(fine[:-1], coarse[:-1], column) for column in nominal.desired.T])
    return replace(
        nominal, problem=replace(nominal.problem, period=nominal.problem.period / share), states=states, desired=desired
    )


RIGHT_MODEL = ControllerQuestion(leaves_right_model_alone, NULL_TEST, order=15, of_targets=True)


QUESTIONS = (
    ControllerQuestion(pays, PAYS, order=14),
    RIGHT_MODEL,
    ControllerQuestion(
        lambda c: right_form(
            c.problem,
            c.controller.deformation,
            c.harm,
            partial(_tried_error, c),
            lambda deformation: _by_coordinate(c.counted(deformation)),
        ),
        FORM,
        order=13,
    ),
)
