"""Does the plain form come back from the largest response error? Behind a saturating map its gain falls with the error.

From the error on at which the gain of the map falls below what the tracking law needs the error grows (`contraction.basin`). The
errors that are met are those predicted along the model's own run, with adaptation, whose steps may be too small for the start, and
without it, and the jumps of disturbances.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.contraction.large_errors import basin_of_plain_form
from fpirhc.errors import InvalidValue
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.neighbourhood import spectrum_near
from fpirhc.review.prediction import errors_without_adaptation, response_errors
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.slew import effect
from fpirhc.review.speed import law_of

TEXT = "Does it come back from the largest response error?"
# The basin is that of a single error. An error that lasts, as after a start off the reference, feeds the tracking law meanwhile:
# in simulated starts up to 0.43 of the basin was lost.
_LASTING, _SPARE = 2.5, 4.0


def comes_back(case: Case) -> Answer | None:
    """Return the largest response error beside the basin; None for other forms, laws without known poles, unbounded steps."""
    deformation = case.controller.deformation
    law, step = law_of(case.grid, case.controller), deformation.largest_step()
    plain = deformation.adapts and deformation.iteration.slows_desired and deformation.iteration.pairing is None
    if law is None or not plain or not (0 < step < math.inf):
        return None
    error = _largest_error(case)
    eigenvalue = _smallest_eigenvalue(case)
    if error is None or eigenvalue is None or law[1] < 2:
        return None
    (rate, poles), period = law, case.problem.period
    basin = basin_of_plain_form(step, poles, rate, period, eigenvalue=eigenvalue)
    ratio = basin / max(error, 1e-300)
    text = f"errors up to {error:.3g} are predicted; it comes back from a single one of {basin:.3g}, {ratio:.3g} times as large"
    text += "" if ratio >= _SPARE else f", where {_SPARE:g} times are wanted, because errors that last add up"
    numbers = {"error": error, "basin": basin}
    if ratio >= _SPARE:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    verdict = Verdict.UNKNOWN if ratio > _LASTING or not deformation.iteration.constant else Verdict.NO
    change = f"Raise the map's scale at least {_SPARE / ratio:.2g} times, or leave it out to have it chosen."
    return Answer(TEXT, verdict, text, change, numbers)


QUESTION = ControllerQuestion(comes_back, order=40, doubts=True)


def _largest_error(case: Case) -> float | None:
    """Largest |f - d| with and without adaptation, and the largest jump of a disturbance; None where nothing predicts it."""
    nominal = case.nominal
    if isinstance(nominal, str):
        return None
    both = [response_errors(nominal).error, errors_without_adaptation(nominal).error]
    with np.errstate(over="ignore", invalid="ignore"):  # the errors of a diverging loop
        sizes = np.linalg.norm(np.vstack(both), axis=1)
    jump = max((d.jump * effect(case.grid, name) for name, d in case.problem.disturbances.items()), default=0.0)
    return max(float(sizes.max()), jump) if np.isfinite(sizes).all() else None


def _smallest_eigenvalue(case: Case) -> float | None:
    """Smallest real part along the reference; None where it is not positive."""
    try:
        smallest = float(
            spectrum_near(case.grid, case.believed, case.grid.draws[:1], near=False).eigenvalues.real.min()
        )
    except InvalidValue:
        return None
    return smallest if smallest > 0 else None
