"""Is the gain admissible? The map's own gain against the limits of the map and of its whole loop, and the recommended gain."""

from __future__ import annotations

import math

from fpirhc.contraction.gains import ContractionReport, assess_gain
from fpirhc.contraction.spectrum import Spectrum
from fpirhc.deformation.base import Deformation
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case
from fpirhc.review.recommended_gain import FAR, Recommended, limit_of_loop

QUESTION = "Is the map's gain admissible?"


def gain_admissible(
    deformation: Deformation, own: Spectrum, boxed: Spectrum, limit: float, advice: Recommended
) -> Answer:
    """Return the interval of admissible gains and the recommended value.

    Args:
        deformation: the map.
        own: eigenvalues of the response Jacobian along the reference, with the exact parameters.
        boxed: the same over the box of parameters.
        limit: limit of gain times eigenvalue, 2 without dead time.
        advice: the recommended gain.
    """
    share = limit / 2
    near, wide = assess_gain(deformation, own), assess_gain(deformation, boxed)
    if not near.sector_limit[0] < near.sector_limit[1]:
        return Answer(QUESTION, Verdict.NO, near.text, "See the question about the eigenvalues' sign.")
    name = near.gain_name
    best = wide if wide.sector_limit[0] < wide.sector_limit[1] else near
    linear = _far(_ends(best.own_linear_limit, share))
    value = near.effective_gain if name == "effective gain" else float(getattr(deformation, name))
    numbers = {"gain": value, "recommended": advice.value, "factor": near.predicted}
    numbers |= {"limit": advice.limit, "linear_limit": linear}
    text = f"{name} = {value:.4g}; {advice.text}"
    change = (
        f"Use {name} = {advice.value:.3g}." if not advice.why_not else "Use another form, or leave the deformation out."
    )
    if not _within(near, near.linear_limit, share):
        return Answer(QUESTION, Verdict.NO, text, change, numbers)
    inside = 0 < value / advice.limit < 1 and _within(wide, wide.sector_limit, share)
    if inside and advice.why_not:
        change = f"It is inside its limits, which does not say that it helps: see whether a comparison does. {change}"
    good = inside and not advice.why_not
    return Answer(QUESTION, Verdict.YES if good else Verdict.UNKNOWN, text, "" if good else change, numbers)


def gain_of_target(case: Case) -> Answer | None:
    """Return the limit of a map on targets, that of its whole loop; None where the gain changes on line or is not known."""
    deformation, loops = case.controller.deformation, case.by_gain
    if loops is None:
        return None
    value, name = deformation.effective_gain(), deformation.gain_name
    own = getattr(deformation, name, None)
    name, scale = ("effective gain", 1.0) if own is None else (name, float(own) / value)
    limit, sets = limit_of_loop(deformation, loops)
    numbers = {"gain": value * scale, "limit": limit * scale, "recommended": limit * scale / 2}
    text = f"{name} = {value * scale:.4g}; "
    if not math.isfinite(limit):
        return Answer(
            QUESTION,
            Verdict.YES,
            f"{text}no gain up to {FAR:g} times as large is a limit of the whole loop",
            "",
            numbers,
        )
    text += f"the smallest limit is {limit * scale:.3g}, set by {sets}"
    if value / limit < 1:
        return Answer(QUESTION, Verdict.YES, text, "", numbers)
    along = case.loops.radii.max() < 1  # in the box it is another matter
    verdict = Verdict.UNKNOWN if along else Verdict.NO
    return Answer(QUESTION, verdict, text, f"Use {name} = {limit * scale / 2:.3g}, half of it.", numbers)


def _within(report: ContractionReport, limit: tuple[float, float], share: float) -> bool:
    lower, upper = _ends(limit, share)
    return lower < report.effective_gain < upper


def _ends(limit: tuple[float, float], share: float) -> tuple[float, float]:
    return limit[0] * share, limit[1] * share


def _far(limit: tuple[float, float]) -> float:
    return limit[0] if abs(limit[0]) > abs(limit[1]) else limit[1]
