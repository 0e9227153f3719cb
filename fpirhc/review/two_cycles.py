"""Can a large error end in a bounded two-cycle? It can, where the map's secant reaches the limit of the whole loop."""

from __future__ import annotations

import math

from fpirhc.contraction.large_errors import two_cycle_amplitudes
from fpirhc.deformation.base import Deformation, innermost
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case
from fpirhc.review.recommended_gain import MARGIN, secant_limit
from fpirhc.review.speed import gain_times

QUESTION = "Is it free of bounded two-cycles?"


def free_of_two_cycles(case: Case) -> Answer | None:
    """Return the map's secant gain beside the smallest that makes a two-cycle along the reference.

    The answer is None without linear loops, and where the response is late: there longer cycles come first.
    """
    if case.problem.response_delay > 0 or case.by_gain is None:
        return None
    deformation, limit = case.controller.deformation, secant_limit(case.by_gain)
    if limit is None:
        return None
    secant = abs(deformation.secant_gain())
    text = f"the steepest secant is {secant:.4g}, a two-cycle begins at {limit:.4g}"
    numbers = {"secant": secant, "limit": limit}
    if secant < limit:
        return Answer(QUESTION, Verdict.YES, text, "", numbers)
    sizes = _amplitudes(innermost(deformation), limit)
    if sizes:
        text += f"; there |f - d| alternates with the size {sizes[-1]:.3g}"
        numbers["amplitude"] = sizes[-1]
    return Answer(QUESTION, Verdict.NO, text, _smaller(case, limit / secant), numbers)


def _smaller(case: Case, factor: float) -> str:
    """The gain at half of the limit, where runs on plant and model speak for it."""
    deformation = case.controller.deformation
    against = case.harm(deformation.with_effective_gain(factor / MARGIN * deformation.effective_gain()))
    if against:
        return (
            f"The limit is {gain_times(deformation, factor)}, but no gain is proposed, because at half of it {against}."
        )
    return f"Use {gain_times(deformation, factor / MARGIN)}, half of the limit."


def _amplitudes(map_: Deformation, limit: float) -> tuple[float, ...]:
    """Sizes of the error in two-cycles of a map with one secant for all directions; empty where they are not known."""
    step = map_.largest_step()
    if not math.isfinite(step):
        return ()
    try:
        return two_cycle_amplitudes(map_, limit, size=step)
    except FpirhcError:
        return ()
