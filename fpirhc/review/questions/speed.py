"""Is the iteration fast enough for its tracking law, and how late may the response be? The poles of the law decide."""

from __future__ import annotations

import numpy as np

from fpirhc.contraction.delayed import bearable_lag, least_product
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import tracking_law
from fpirhc.deformation.base import Deformation, own_gain
from fpirhc.plant.maps import response_age
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import is_planned
from fpirhc.review.question import Answer, Case, ControllerQuestion, Verdict, graded
from fpirhc.review.questions.right_model import INCREMENT, REFERENCED, forms_of

FAST = "Does the iteration keep up with its tracking law?"
LAG = "Does it bear a small lag that is not in the model?"
_FORMS = {REFERENCED: "ModelReferenced", INCREMENT: "Increment"}
_SPARE = 3.0
_DAMPING = 0.3
_CYCLES = 3.0  # of lag that it should bear


def fast_enough(case: Case) -> Answer | None:
    """Return the smallest a lambda beside the one that the plain form needs; None for other forms, unknown poles, and maps."""
    grid, controller = case.grid, case.controller
    law = law_of(grid, controller)
    if law is None or case.spectra is None or not controller.deformation.iteration.slows_desired:
        return None
    rate, poles = law
    product = _products(case)[0]
    ratio = product / least_product(poles, rate, grid.problem.period)
    text = f"gain x eigenvalue is at least {product:.3g}, {ratio:.3g} times what {poles} poles"
    text += f" at {rate:g} {grid.problem.rate_unit} need"
    numbers = {"product": product, "ratio": ratio}
    verdict = graded(ratio, _SPARE)
    change = "" if verdict == Verdict.YES else faster(case, _SPARE / ratio, "lower rate x period")
    return Answer(FAST, verdict, text, change, numbers)


def faster(case: Case, factor: float, otherwise: str) -> str:
    """Return what to do: a form or a larger gain that runs on plant and model speak for, or else something that is not run."""
    deformation = case.controller.deformation
    forms = forms_of(case.problem, deformation)
    passing = [name for kind, name in _FORMS.items() if kind in forms and not case.harm(forms[kind])]
    ways = [f"use a form that passes the desired response at once ({', '.join(passing)})"] if passing else []
    if case.lowers(deformation.with_effective_gain(factor * deformation.effective_gain())):
        ways.append(f"use {gain_times(deformation, factor)}")
    text = ", or ".join([*ways, otherwise])
    return f"{text[0].upper()}{text[1:]}."


def gain_times(deformation: Deformation, factor: float) -> str:
    """Return the map's own gain times a factor as text, 'gain = -1.2'."""
    larger = deformation.with_effective_gain(factor * deformation.effective_gain())
    name, value = own_gain(larger)
    return f"{name} = {value:.3g}"


def bears_lag(case: Case) -> Answer | None:
    """Return the longest unknown lag with which the fast modes are still damped.

    None for laws without known poles, for maps, and where the response is late already.
    """
    grid = case.grid
    law, period, unit = law_of(grid, case.controller), grid.problem.period, grid.problem.time_unit
    if law is None or case.spectra is None or grid.problem.response_delay > 0:
        return None
    (rate, poles), product = law, _products(case)[1]
    longest = bearable_lag(product, period, rate, poles, damping=_DAMPING)
    limit = 1 / (poles * rate)
    size = f"{longest / period:.3g}"
    cycles = f"{size} cycle{'s' * (size != '1')}"
    text = (
        f"up to {longest:.3g} {unit} ({cycles}) of an actuator or a sensor with damping {_DAMPING:g}; beyond "
        f"{limit:.3g} {unit} a fast iteration is unstable at any gain"
    )
    numbers = {"lag": longest, "limit": limit}
    verdict = Verdict.YES if longest >= _CYCLES * period else Verdict.CAUTION
    return Answer(LAG, verdict, text, "Lower the gain, or model the lag and pair through it.", numbers)


def law_of(grid: ReviewGrid, controller: Controller) -> tuple[float, int] | None:
    """Return rate and number of poles of the tracking law for the most demanding coordinate; None where there is no such law.

    That of a map has no rate: its linear loop is exact.
    """
    law, plant = tracking_law(controller), grid.problem.plant
    laws = [law.feedback(plant.chains[n]) for n in plant.controlled_names] if law and not response_age(plant) else []
    known = [(one.rate, len(one.gains)) for one in laws if one is not None and one.rate is not None]
    return max(known, key=lambda pair: pair[1]) if known else None


def _products(case: Case) -> tuple[float, float]:
    """Smallest and largest |a lambda| along the reference."""
    assert case.spectra is not None
    sizes = abs(case.controller.deformation.effective_gain()) * abs(case.spectra[0].eigenvalues)
    return float(sizes.min()), float(sizes.max())


_PLAN_SPARE = 1.5
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
    least, loop = "at least " * (factor <= _SMALLEST), "plan" if is_planned(case.controller) else "loop"
    text = f"the effective gain is {size:.3g}, {least}{ratio:.3g} times the smallest with which the {loop} converges"
    numbers = {"ratio": ratio, "least": factor * size}
    if ratio >= _PLAN_SPARE:
        return Answer(FAST, Verdict.YES, text, "", numbers)
    verdict = Verdict.NO if ratio < 1 and not case.controller.learns else Verdict.CAUTION
    return Answer(FAST, verdict, text, faster(case, _PLAN_SPARE * factor, "plan with a shorter period"), numbers)


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


QUESTIONS = (
    ControllerQuestion(fast_enough, FAST, order=9),
    ControllerQuestion(bears_lag, LAG, order=10),
    ControllerQuestion(plan_keeps_up, FAST, order=60),
)
