"""What does the noise of measured responses do? The chatter of the commands, and the gain and filter that it asks for.

The pair is that of `suggest`: the largest gain with which noise alone moves no input by more than its budget per cycle. The
budget is 1 % of the range between the limits of an input. Where no input has limits it is the chatter of the deformation in use,
so that the pair adapts as fast as it can at the same price.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.suggest import chatter_of, within_budget

CHATTER = "Is the chatter from measured responses small?"
SMALL = 0.01  # of the range between an input's limits


def chatter_small(grid: ReviewGrid, controller: Controller) -> Answer | None:
    """Return the rms steps of the commands that noise causes; None without white noise on a response, or where it is late."""
    problem, deformation = grid.problem, controller.deformation
    if problem.sensing.ideal or problem.response_delay > 0 or not deformation.iteration.constant:
        return None
    try:
        steps = chatter_of(grid, controller, deformation.effective_gain(), deformation.iteration.error_pole)
    except FpirhcError:
        return None
    lower, upper = problem.limits.input_bounds(problem.plant)
    share = float(np.max(np.array(list(steps.values())) / (upper - lower)))
    text = "rms step per cycle from noise: " + ", ".join(f"{i} {v:.3g}" for i, v in steps.items())
    numbers = {f"step_{i}": v for i, v in steps.items()} | {"share_of_limits": share}
    if share < SMALL:
        return Answer(CHATTER, Verdict.YES, text, "", numbers)
    change = "fp.suggest(problem, controller, chatter=...) gives the gain and the filter for a smaller one."
    return Answer(CHATTER, Verdict.UNKNOWN, text, change, numbers)


NOISE_PAIR = "Are gain and filter those that the sensors' noise asks for?"
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
        return Answer(NOISE_PAIR, Verdict.UNKNOWN, str(error))
    pole = deformation.iteration.error_pole
    gain, share = abs(deformation.effective_gain()), abs(deformation.effective_gain() / pair.effective_gain)
    numbers = {"gain": gain, "pole": pole, "recommended": abs(pair.effective_gain), "recommended_pole": pair.pole}
    allowed = ", ".join(f"{name} {value:.3g}" for name, value in budget.items())
    text = (
        f"effective gain {gain:.3g} and pole {pole:.3g}; with steps per cycle of {allowed} from noise the pair "
        f"is {abs(pair.effective_gain):.3g} and {pair.pole:.3g}"
    )
    if share >= _ENOUGH and all(steps[name] <= 1.01 * value for name, value in budget.items()):
        return Answer(NOISE_PAIR, Verdict.YES, text, "", numbers)
    against = case.harm(pair.deformation)
    if against:
        change = "Less noise at the response is needed: a better sensor, an estimator, or a longer period."
        return Answer(NOISE_PAIR, Verdict.UNKNOWN, f"{text}, but {against}", change, numbers)
    change = f"Use {pair.gain_name} = {pair.gain:.3g}" + (
        f" in Filtered(map, pole={pair.pole:.3g})." if pair.pole else " without a filter."
    )
    return Answer(NOISE_PAIR, Verdict.UNKNOWN, text, change, numbers)


def _budget(case: Case) -> dict[str, float]:
    """1 % of the range of every input with limits."""
    lower, upper = case.problem.limits.input_bounds(case.problem.plant)
    sizes = SMALL * (np.asarray(upper) - np.asarray(lower))
    return {name: float(s) for name, s in zip(case.problem.plant.inputs, sizes, strict=True) if math.isfinite(s)}


QUESTIONS = (
    ControllerQuestion(lambda case: chatter_small(case.grid, case.controller), CHATTER, order=12),
    ControllerQuestion(suits_noise, NOISE_PAIR, order=70),
)
