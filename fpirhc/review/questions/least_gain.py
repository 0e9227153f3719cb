"""Is the gain large enough for the plan? In the plain form a small gain is worse than none.

The plain form passes the desired response through a low-pass with the pole 1 - a lambda. Around a tracking law with known poles
`speed` asks for a lambda / (T Lambda) above 1/2, 9/8, 1.76, 2.39. A plan that restarts from the measured state has no such
formula: here the smallest stable gain is sought in its linear loop, whose matrix is F0 + a F1 for every gain a.
"""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.contract import tracking_law
from fpirhc.deformation.base import Deformation
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.forms import forms_of
from fpirhc.review.loops import loops_at
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.speed import FAST

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
    return Answer(FAST, verdict, text, _remedy(case, _SPARE * factor), numbers)


QUESTION = ControllerQuestion(plan_keeps_up, order=30)


def gain_times(deformation: Deformation, factor: float) -> str:
    """Return the map's own gain times a factor as text, 'gain = -1.2'."""
    larger = deformation.with_effective_gain(factor * deformation.effective_gain())
    own = getattr(larger, larger.gain_name, None)
    return f"effective gain = {larger.effective_gain():.3g}" if own is None else f"{larger.gain_name} = {own:.3g}"


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


def _remedy(case: Case, factor: float) -> str:
    """The gain that would do, and the forms that converge with the present one."""
    deformation = case.controller.deformation
    names = []
    for name, form in forms_of(case.problem, deformation).items():
        if form.iteration.slows_desired:
            continue
        try:
            loops = loops_at(case.grid, case.controller.with_deformation(form), case.loops.places[:1])
        except FpirhcError:
            continue
        if loops[0].radius < 1:
            names.append(name)
    forms = f", or the {' or '.join(names)} form, which converges with this gain" if names else ""
    return f"Use {gain_times(deformation, factor)} or more{forms}."
