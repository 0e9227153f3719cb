"""Is the iteration fast enough for its tracking law, and how late may the response be? The poles of the law decide."""

from __future__ import annotations

from fpirhc.contraction.lag import bearable_lag
from fpirhc.contraction.large_errors import least_product
from fpirhc.contraction.spectrum import Spectrum
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import tracking_law
from fpirhc.deformation.base import Deformation
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.forms import INCREMENT, REFERENCED, forms_of
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import Case

FAST = "Does the iteration keep up with its tracking law?"
LAG = "Does it bear a small lag that is not in the model?"
_FORMS = {REFERENCED: "ModelReferenced", INCREMENT: "Increment"}
_SPARE = 3.0
_DAMPING = 0.3
_CYCLES = 3.0  # of lag that it should bear


def fast_enough(case: Case, own: Spectrum) -> Answer | None:
    """Return the smallest a lambda beside the one that the plain form needs; None for other forms, unknown poles, and maps."""
    grid, controller = case.grid, case.controller
    law = law_of(grid, controller)
    if grid.problem.plant.step is not None:
        return None  # the linear loop of a map is exact
    if law is None or not controller.deformation.iteration.slows_desired:
        return None
    rate, poles = law
    product = _products(controller, own)[0]
    ratio = product / least_product(poles, rate, grid.problem.period)
    text = f"gain x eigenvalue is at least {product:.3g}, {ratio:.3g} times what {poles} poles"
    text += f" at {rate:g} {grid.problem.rate_unit} need"
    numbers = {"product": product, "ratio": ratio}
    if ratio >= _SPARE:
        return Answer(FAST, Verdict.YES, text, "", numbers)
    return Answer(
        FAST,
        Verdict.NO if ratio < 1 else Verdict.UNKNOWN,
        text,
        faster(case, _SPARE / ratio, "lower rate x period"),
        numbers,
    )


def faster(case: Case, factor: float, otherwise: str) -> str:
    """Return what to do: a form or a larger gain that runs on plant and model speak for, or else something that is not run.

    Args:
        case: of a controller that is too slow.
        factor: by which the gain would grow.
        otherwise: what helps without another form or gain.
    """
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
    own = getattr(larger, larger.gain_name, None)
    return f"effective gain = {larger.effective_gain():.3g}" if own is None else f"{larger.gain_name} = {own:.3g}"


def bears_lag(grid: ReviewGrid, controller: Controller, own: Spectrum) -> Answer | None:
    """Return the longest unknown lag with which the fast modes are still damped.

    None for laws without known poles, for maps, and where the response is late already.
    """
    law, period, unit = law_of(grid, controller), grid.problem.period, grid.problem.time_unit
    if law is None or grid.problem.response_delay > 0 or grid.problem.plant.step is not None:
        return None
    (rate, poles), product = law, _products(controller, own)[1]
    longest = bearable_lag(product, period, rate, poles, damping=_DAMPING)
    limit = 1 / (poles * rate)
    text = (
        f"up to {longest:.3g} {unit} ({longest / period:.3g} cycles) of an actuator or a sensor with damping {_DAMPING:g}; beyond "
        f"{limit:.3g} {unit} a fast iteration is unstable at any gain"
    )
    numbers = {"lag": longest, "limit": limit}
    if longest >= _CYCLES * period:
        return Answer(LAG, Verdict.YES, text, "", numbers)
    return Answer(LAG, Verdict.UNKNOWN, text, "Lower the gain, or model the lag and pair through it.", numbers)


def law_of(grid: ReviewGrid, controller: Controller) -> tuple[float, int] | None:
    """Return rate and number of poles of the tracking law for the most demanding coordinate; None where there is no such law."""
    law, plant = tracking_law(controller), grid.problem.plant
    laws = [law.feedback(plant.chains[n]) for n in plant.controlled_names] if law else []
    known = [(one.rate, len(one.gains)) for one in laws if one is not None and one.rate is not None]
    return max(known, key=lambda pair: pair[1]) if known else None


def _products(controller: Controller, own: Spectrum) -> tuple[float, float]:
    """Smallest and largest |a lambda| along the reference."""
    sizes = abs(controller.deformation.effective_gain()) * abs(own.eigenvalues)
    return float(sizes.min()), float(sizes.max())
