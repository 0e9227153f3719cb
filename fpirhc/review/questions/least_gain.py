"""Is the gain large enough for the plan? In the plain form a small gain is worse than none.

The plain form passes the desired response through a low-pass with the pole 1 - a lambda. Around a tracking law with known poles
`speed` asks for a lambda / (T Lambda) above 1/2, 9/8, 1.76, 2.39. A plan that restarts from the measured state has no such
formula: here the smallest stable gain is sought in its linear loop, whose matrix is F0 + a F1 for every gain a.
"""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.contract import tracking_law
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.speed import FAST, faster

_SPARE = 1.5
_SMALLEST, _LARGEST, _STEPS = 1e-3, 30.0, 80  # factors of the map's own gain that are searched
_POINTS = 3


def plan_keeps_up(case: Case) -> Answer | None:
    """Return the map's gain over the smallest stable one of its plan; None for other forms and laws with known poles."""
    deformation = case.controller.deformation
    if (
        tracking_law(case.controller) is not None
        or not deformation.iteration.slows_desired
        or not deformation.iteration.constant
    ):
        return None
    factor = _least_factor(case) if case.loops.loops and deformation.effective_gain() else None
    too_large = factor is not None and factor <= 1 and case.loops.radii.max() >= 1  # which other questions say
    if factor is None or too_large:
        return None
    ratio = 1 / factor
    size = abs(deformation.effective_gain())
    text = f"the effective gain is {size:.3g}, {ratio:.3g} times the smallest with which the plan converges"
    numbers = {"ratio": ratio, "least": factor * size}
    if ratio >= _SPARE:
        return Answer(FAST, Verdict.YES, text, "", numbers)
    verdict = Verdict.NO if ratio < 1 and not case.controller.learns else Verdict.UNKNOWN
    return Answer(FAST, verdict, text, faster(case, _SPARE * factor, "plan with a shorter period"), numbers)


QUESTION = ControllerQuestion(plan_keeps_up, order=30)


def _least_factor(case: Case) -> float | None:
    """Smallest factor of the map's gain from which on gains converge; None where none of those tried does."""
    loops = case.by_gain
    if loops is None:
        return None
    factors, pairs = np.geomspace(_SMALLEST, _LARGEST, _STEPS), loops.along(_POINTS)

    def stable(factor: float) -> bool:
        return all(loops.at(factor * loops.gains[1], pair).radius < 1 for pair in pairs)

    first = next((k for k, factor in enumerate(factors) if stable(float(factor))), None)
    if first is None:
        return None
    if first == 0:
        return float(factors[0])
    low, high = float(factors[first - 1]), float(factors[first])
    for _ in range(20):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if stable(middle) else (middle, high)
    return high
