"""Is the gain admissible? The map's own gain against its linear and sector limits, along the reference and over the box."""

from __future__ import annotations

import math

from fpirhc.contraction import ContractionReport, Spectrum, assess_gain
from fpirhc.deformation.base import Deformation
from fpirhc.review.answer import Answer, Verdict

QUESTION = "Is the map's gain admissible?"


def gain_admissible(deformation: Deformation, own: Spectrum, boxed: Spectrum, limit: float) -> Answer:
    """Return the interval of admissible gains and the recommended value.

    Args:
        deformation: the map.
        own: eigenvalues of the response Jacobian along the reference, with the exact parameters.
        boxed: the same over the box of parameters.
        limit: limit of gain times eigenvalue, 2 without dead time.
    """
    share = limit / 2
    near, wide = assess_gain(deformation, own), assess_gain(deformation, boxed)
    name = near.gain_name
    best = wide if math.isfinite(wide.recommended) else near
    sector, linear = (_ends(i, share) for i in (best.own_sector_limit, best.own_linear_limit))
    value = near.effective_gain if name == "effective gain" else float(getattr(deformation, name))
    recommended = best.recommended * share
    numbers = {"gain": value, "recommended": recommended, "factor": near.predicted}
    numbers |= {"sector_limit": _far(sector), "linear_limit": _far(linear)}
    text = (
        f"{name} = {value:.4g}; admissible 0 to {_far(sector):.3g} for errors of any size, to {_far(linear):.3g} for small ones; "
        f"recommended {recommended:.3g}"
    )
    if not math.isfinite(recommended):
        return Answer(QUESTION, Verdict.NO, near.text, "See the question about the eigenvalues' sign.", numbers)
    change = f"Use {name} = {recommended:.3g}."
    if not _within(near, near.linear_limit, share):
        return Answer(QUESTION, Verdict.NO, text, change, numbers)
    good = _within(wide, wide.sector_limit, share)
    return Answer(QUESTION, Verdict.YES if good else Verdict.UNKNOWN, text, "" if good else change, numbers)


def _within(report: ContractionReport, limit: tuple[float, float], share: float) -> bool:
    lower, upper = _ends(limit, share)
    return lower < report.effective_gain < upper


def _ends(limit: tuple[float, float], share: float) -> tuple[float, float]:
    return limit[0] * share, limit[1] * share


def _far(limit: tuple[float, float]) -> float:
    return limit[0] if abs(limit[0]) > abs(limit[1]) else limit[1]
