"""Does adaptation lower the response error? It is predicted along the model's own run, with and without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.deformation.identity import Identity
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.prediction import NominalRun, ResponseErrors, nominal_run, response_errors

QUESTION = "Does adaptation lower the response error?"
_CYCLES = 2000  # of the model's run
_HARM = 0.5  # share of the error without adaptation that adaptation may make of a model that is right


def pays(grid: ReviewGrid, controller: Controller) -> Answer:
    """Return the rms response errors without adaptation, with it, and with it on a right model, where every change does harm."""
    problem = grid.problem
    shorter = min(problem.duration, _CYCLES * problem.period)
    shortened = replace(problem, duration=shorter, measure_from=min(problem.measure_from, 0.5 * shorter))
    try:
        nominal = nominal_run(shortened, controller, compiled=False)
        without = _rms(nominal, response_errors(nominal, deformation=Identity()))
        adapted = _rms(nominal, response_errors(nominal))
        null = _rms(nominal, response_errors(nominal, exact=nominal.believed))
    except FpirhcError as error:
        return Answer(QUESTION, Verdict.UNKNOWN, str(error))
    text = f"predicted rms response error: {without:.3g} without adaptation, {adapted:.3g} with it, {null:.3g} with a right model"
    numbers = {"without": without, "with": adapted, "null": null}
    if not adapted < without:
        change = "Raise the gain, shorten the period, or leave the deformation out: the model is right enough."
        return Answer(QUESTION, Verdict.NO, text, change, numbers)
    if null > _HARM * without:
        change = "Adaptation would do harm with a slightly better model: raise the gain or shorten the period."
        return Answer(QUESTION, Verdict.UNKNOWN, text, change, numbers)
    return Answer(QUESTION, Verdict.YES, text, "", numbers)


def _rms(nominal: NominalRun, errors: ResponseErrors) -> float:
    """Rms response error over all coordinates, from `measure_from` on; infinite where the errors do not stay finite."""
    first = min(round(nominal.problem.measure_from / nominal.problem.period), nominal.cycles - 1)
    with np.errstate(over="ignore", invalid="ignore"):
        size = float(np.sqrt(np.mean(np.sum(errors.error[first:] ** 2, axis=1))))
    return size if np.isfinite(size) else float("inf")
