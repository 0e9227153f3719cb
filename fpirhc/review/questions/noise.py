"""What does the noise of sensors do? The chatter of the commands, and the gain and filter that it asks for.

The pair is that of `suggest`: the largest gain with which noise alone moves no input by more than its budget per cycle. The
budget is 1 % of the range between the limits of an input. Where no input has limits it is the chatter of the deformation in use,
so that the pair adapts as fast as it can at the same price.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.loops import points_of, thinned
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.suggest import chatter_of, within_budget
from fpirhc.simulation.linearise.linear_loop import LinearLoop

CHATTER = "Is the chatter from measured responses small?"
SMALL = 0.01  # of the range between an input's limits
_POINTS = 3  # of the reference, whose loops are asked
_DRAWN = 20_000
_WHITE = 0.03  # correlation of a drawn series with itself one cycle later, below which it is white


def chatter_small(case: Case) -> Answer | None:
    """Return the rms steps of the commands that noise causes in the whole loop, by its discrete Lyapunov equation.

    None without noise, for maps and models that change on line, and where a linear loop does not converge.
    """
    problem, deformation = case.problem, case.controller.deformation
    loops = _noisy_loops(case) if deformation.iteration.constant or not deformation.adapts else None
    if loops is None:
        return None
    rms = np.max([one.steps(covariance) for one, covariance in loops], axis=0)
    steps = dict(zip(problem.plant.inputs, map(float, rms), strict=True))
    lower, upper = problem.limits.input_bounds(problem.plant)
    share = float(np.max(rms / (upper - lower)))
    text = "rms step per cycle from noise: " + ", ".join(f"{i} {v:.3g}" for i, v in steps.items())
    numbers = {f"step_{i}": v for i, v in steps.items()} | {"share_of_limits": share}
    if share < SMALL:
        return Answer(CHATTER, Verdict.YES, text, "", numbers)
    change = "fp.suggest(problem, controller, chatter=...) gives the gain and the filter for a smaller one."
    if not deformation.adapts:
        change = "Lower the rate, weigh the change of the inputs, or estimate more slowly."
    elif problem.response_delay > 0:
        change = "Lower the gain, filter its error (Filtered), or estimate more slowly."
    return Answer(CHATTER, Verdict.UNKNOWN, text, change, numbers)


def _noisy_loops(case: Case) -> list[tuple[LinearLoop, np.ndarray]] | None:
    """Linear loops behind the sensors' noise, each with the covariance of what drives it; None where one does not converge."""
    noises = [one.noise for one in case.problem.sensing.sensors.values() if one.noise is not None]
    if not noises or not case.loops.loops or case.loops.radii.max() >= 1 or case.loops.learns:
        return None
    times, random = case.problem.period * np.arange(_DRAWN), np.random.default_rng(0)
    series = np.array([one.values(times, random) for one in noises])
    points, variances = points_of(case.grid, case.controller), series.var(axis=1)
    kept = np.mean(series[:, 1:] * series[:, :-1], axis=1) / np.maximum(variances, 1e-300)
    kept = np.where(np.abs(kept) < _WHITE, 0.0, kept)
    loops = [points.noisy(k, kept) for k in thinned(case.loops.places, _POINTS)]
    if any(np.abs(one.poles).max(initial=0.0) >= 1 for one in loops):
        return None
    return [(one, np.diag(variances * (1 - kept**2))) for one in loops]


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
    ControllerQuestion(chatter_small, CHATTER, order=12, adaptive=False),
    ControllerQuestion(suits_noise, NOISE_PAIR, order=70),
)
