"""Which gain and which pole of the error's filter does the noise of the problem's sensors ask for?

The pair is that of `suggest`: the largest gain with which noise alone moves no input by more than its budget per cycle. The
budget is 1 % of the range between the limits of an input, as in the question about chatter. Where no input has limits it is the
chatter of the deformation in use, so that the pair adapts as fast as it can at the same price.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.chatter import SMALL
from fpirhc.review.noise_along import chatter_of
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.suggest import within_budget

TEXT = "Are gain and filter those that the sensors' noise asks for?"
_ENOUGH = 0.5  # share of the suggested gain that is as good


def suits_noise(case: Case) -> Answer | None:
    """Return gain and pole for the problem's sensors beside those in use; None without noise or for a map that changes on line."""
    deformation = case.controller.deformation
    noisy = any(sensor.noise is not None for sensor in case.problem.sensing.sensors.values())
    if not noisy or not deformation.iteration.constant or case.problem.response_delay > 0:
        return None
    try:
        steps = chatter_of(case.grid, case.controller, deformation.effective_gain(), deformation.iteration.error_pole)
        budget = _budget(case) or steps
        pair = within_budget(case.problem, case.controller, chatter=budget)
    except FpirhcError as error:
        return Answer(TEXT, Verdict.UNKNOWN, str(error))
    pole = deformation.iteration.error_pole
    gain, share = abs(deformation.effective_gain()), abs(deformation.effective_gain() / pair.effective_gain)
    numbers = {"gain": gain, "pole": pole, "recommended": abs(pair.effective_gain), "recommended_pole": pair.pole}
    allowed = ", ".join(f"{name} {value:.3g}" for name, value in budget.items())
    text = (
        f"effective gain {gain:.3g} and pole {pole:.3g}; with steps per cycle of {allowed} from noise the pair "
        f"is {abs(pair.effective_gain):.3g} and {pair.pole:.3g}"
    )
    if share >= _ENOUGH and all(steps[name] <= 1.01 * value for name, value in budget.items()):
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    against = case.harm(pair.deformation)
    if against:
        change = "Less noise at the response is needed: a better sensor, an estimator, or a longer period."
        return Answer(TEXT, Verdict.UNKNOWN, f"{text}, but {against}", change, numbers)
    change = f"Use {pair.gain_name} = {pair.gain:.3g}" + (
        f" in Filtered(map, pole={pair.pole:.3g})." if pair.pole else " without a filter."
    )
    return Answer(TEXT, Verdict.UNKNOWN, text, change, numbers)


QUESTION = ControllerQuestion(suits_noise, order=50)


def _budget(case: Case) -> dict[str, float]:
    """1 % of the range of every input with limits."""
    lower, upper = case.problem.limits.input_bounds(case.problem.plant)
    sizes = SMALL * (np.asarray(upper) - np.asarray(lower))
    return {name: float(s) for name, s in zip(case.problem.plant.inputs, sizes, strict=True) if math.isfinite(s)}
