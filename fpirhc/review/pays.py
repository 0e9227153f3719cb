"""Does adaptation lower the response error? It is predicted along the own run of the model, else run on the plant."""

from __future__ import annotations

import numpy as np

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.prediction import NominalRun, ResponseErrors, errors_without_adaptation, response_errors
from fpirhc.review.question import TRIED, Case

QUESTION = "Does adaptation lower the response error?"
_HARM = 0.5  # share of the error without adaptation that adaptation may make of a model that is right

ROUNDING = 1e-6  # of the desired response's rms, below which a response error is rounding


def pays(case: Case) -> Answer:
    """Return the rms response errors without adaptation, with it, and with it on a right model, where every change does harm."""
    nominal = case.nominal
    if isinstance(nominal, str):
        return _by_runs(case, nominal)
    without = rms(nominal, errors_without_adaptation(nominal))
    adapted = rms(nominal, response_errors(nominal))
    null = rms(nominal, response_errors(nominal, exact=nominal.believed))
    text = f"predicted rms response error: {without:.3g} without adaptation, {adapted:.3g} with it, {null:.3g} with a right model"
    numbers = {"without": without, "with": adapted, "null": null}
    if case.loops.loops and case.loops.radii.min() >= 1 and not case.loops.learns:
        change = "The prediction leaves the outer loop out, and this one does not converge: see the convergence."
        return Answer(QUESTION, Verdict.NO, f"{text}, but errors grow in every cycle", change, numbers)
    if max(without, adapted) <= ROUNDING * nominal_size(nominal):
        return Answer(QUESTION, Verdict.UNKNOWN, f"{text}: there is no error to lower", "", numbers)
    if not adapted < without:
        return _no_gain(text, numbers, elsewhere=case.grid.elsewhere)
    if null > _HARM * without:
        change = "Adaptation would do harm with a slightly better model: raise the gain or shorten the period."
        return Answer(QUESTION, Verdict.UNKNOWN, text, change, numbers)
    return Answer(QUESTION, Verdict.YES, text, "", numbers)


def _by_runs(case: Case, reason: str) -> Answer:
    """The answer where nothing predicts it: the tracking errors of two runs on the plant decide."""
    trial = case.trial(case.controller.deformation)
    pair = None if isinstance(trial, str) else trial[0]
    if pair is None:
        why = trial if isinstance(trial, str) else "the plant is outside"
        return Answer(QUESTION, Verdict.UNKNOWN, f"{reason}; and no run, because {why}")
    numbers = {"without": pair.without[pair.worst], "with": pair.adapted[pair.worst]}
    text = f"in a run of at most {TRIED} cycles {pair.sentence} ({reason})"
    if pair.lower:
        return Answer(QUESTION, Verdict.YES, text, "", numbers)
    if pair.fails and not case.controller.learns:
        return Answer(
            QUESTION, Verdict.NO, text, "Lower the gain, use another form, or leave the deformation out.", numbers
        )
    return Answer(QUESTION, Verdict.UNKNOWN, text, "Run it for longer and compare.", numbers)


def _no_gain(text: str, numbers: dict[str, float], *, elsewhere: bool) -> Answer:
    """The answer where adaptation does not lower the predicted error."""
    if elsewhere:
        text += ", for the exact values of the model's own parameters, which move nothing beside a reality"
        return Answer(QUESTION, Verdict.UNKNOWN, text, "Run it and compare.", numbers)
    change = "Leave the deformation out, or use a form that leaves a right model alone: the model is right enough."
    return Answer(QUESTION, Verdict.NO, text, change, numbers)


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
