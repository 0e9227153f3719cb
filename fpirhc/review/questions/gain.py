"""Is the gain admissible? The map's own gain against the limits of the map and of its whole loop, and the recommended gain."""

from __future__ import annotations

import math
from dataclasses import replace

from fpirhc.contraction.gains import ContractionReport, assess_gain
from fpirhc.contraction.large_errors import two_cycle_amplitudes
from fpirhc.contraction.spectrum import Spectrum
from fpirhc.deformation.base import Deformation, innermost
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import SEE_CONVERGENCE, Case, ControllerQuestion
from fpirhc.review.questions.right_model import RIGHT_MODEL
from fpirhc.review.questions.speed import gain_times
from fpirhc.review.recommended_gain import (
    FAR,
    MARGIN,
    OUTSIDE,
    Recommended,
    gain_advice,
    least_gain,
    limit_of_loop,
    secant_limit,
)
from fpirhc.review.spectra import largest_product

GAIN = "Is the map's gain admissible?"
NO_GAIN = "Use another form, or leave the deformation out."


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
        return Answer(GAIN, Verdict.NO, near.text, "See the question about the eigenvalues' sign.")
    name = near.gain_name
    best = wide if wide.sector_limit[0] < wide.sector_limit[1] else near
    linear = _far(_ends(best.own_linear_limit, share))
    value = near.effective_gain if name == "effective gain" else float(getattr(deformation, name))
    numbers = {"gain": value, "recommended": advice.value, "factor": near.predicted}
    numbers |= {"limit": advice.limit, "linear_limit": linear}
    text = f"{name} = {value:.4g}; {advice.text}"
    change = f"Use {name} = {advice.value:.3g}." if not advice.why_not else NO_GAIN
    if not _within(near, near.linear_limit, share):
        return Answer(GAIN, Verdict.NO, text, change, numbers)
    inside = 0 < value / advice.limit < 1 and _within(wide, wide.sector_limit, share)
    if inside and advice.why_not:
        change = f"It is inside its limits, which does not say that it helps: see whether a comparison does. {change}"
    good = inside and not advice.why_not
    return Answer(GAIN, Verdict.YES if good else Verdict.UNKNOWN, text, "" if good else change, numbers)


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
            GAIN, Verdict.YES, f"{text}no gain up to {FAR:g} times as large is a limit of the whole loop", "", numbers
        )
    text += f"the smallest limit is {limit * scale:.3g}, set by {sets}"
    if value / limit < 1:
        return Answer(GAIN, Verdict.YES, text, "", numbers)
    along = case.loops.radii.max() < 1  # in the box it is another matter
    verdict = Verdict.UNKNOWN if along else Verdict.NO
    return Answer(GAIN, verdict, text, f"Use {name} = {limit * scale / 2:.3g}, half of it.", numbers)


def _within(report: ContractionReport, limit: tuple[float, float], share: float) -> bool:
    lower, upper = _ends(limit, share)
    return lower < report.effective_gain < upper


def _ends(limit: tuple[float, float], share: float) -> tuple[float, float]:
    return limit[0] * share, limit[1] * share


def _far(limit: tuple[float, float]) -> float:
    return limit[0] if abs(limit[0]) > abs(limit[1]) else limit[1]


ONE_SIGN = "Do the eigenvalues of the response Jacobian have one sign?"


def one_sign(own: Spectrum, boxed: Spectrum) -> Answer:
    """Return the real parts along the reference, with the exact parameters and over the box."""
    text = f"real parts {own.smallest_real:.3g} to {own.largest_real:.3g}"
    text += f", over the box {boxed.smallest_real:.3g} to {boxed.largest_real:.3g}"
    numbers = {"smallest": own.smallest_real, "largest": own.largest_real}
    numbers |= {"smallest_over_box": boxed.smallest_real, "largest_over_box": boxed.largest_real}
    change = "Give the approximate parameters the sign of every input's effect, and let each input act on its own coordinate."
    if not own.one_sign:
        return Answer(ONE_SIGN, Verdict.NO, text, change, numbers)
    verdict = Verdict.YES if boxed.one_sign else Verdict.UNKNOWN
    return Answer(ONE_SIGN, verdict, text, "" if boxed.one_sign else change, numbers)


TWO_CYCLES = "Is it free of bounded two-cycles?"


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
        return Answer(TWO_CYCLES, Verdict.YES, text, "", numbers)
    sizes = _amplitudes(innermost(deformation), limit)
    if sizes:
        text += f"; there |f - d| alternates with the size {sizes[-1]:.3g}"
        numbers["amplitude"] = sizes[-1]
    return Answer(TWO_CYCLES, Verdict.NO, text, _smaller(case, limit / secant), numbers)


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


def _sign(case: Case) -> Answer:
    if case.spectra is None:
        text = "no finite eigenvalue of the response Jacobian: the inverse response is singular all along the reference"
        return Answer(ONE_SIGN, Verdict.UNKNOWN, text, "See whether the inverse exists.")
    return one_sign(*case.spectra)


def _gain(case: Case) -> Answer | None:
    """Of a map on targets the loop alone decides; None where there is no finite response Jacobian."""
    if case.controller.deforms == "target":
        return gain_of_target(case)
    if case.spectra is None:
        return None
    own, boxed = case.spectra
    deformation = case.controller.deformation
    limit = largest_product(case.problem, deformation, own.eigenvalues)
    advice = gain_advice(case, boxed, case.answer(RIGHT_MODEL))
    answer = _converging(case, gain_admissible(deformation, own, boxed, limit, advice), advice)
    if answer.verdict == Verdict.UNKNOWN and advice.why_not == OUTSIDE:
        return replace(answer, change="fpirhc probe measures them and recommends a gain.")
    return answer


def _converging(case: Case, answer: Answer, advice: Recommended) -> Answer:
    """The answer, or no where the loop diverges with the gain all along the reference: too large, too small, or with any gain."""
    loops = case.by_gain
    if answer.verdict == Verdict.NO or loops is None or not case.diverges:
        return answer
    numbers = dict(answer.numbers)
    value = numbers["gain"]
    if abs(value) >= abs(advice.limit):
        return replace(answer, verdict=Verdict.NO)
    own = value / loops.gains[1]
    least = least_gain(loops, advice.limit / own) if math.isfinite(advice.limit) else None
    if least is None:
        text = f"{answer.evidence}; with {value:.4g} it does not converge either"
        return replace(answer, verdict=Verdict.NO, evidence=text, change=SEE_CONVERGENCE)
    numbers["least"] = least * own
    text = f"{answer.evidence}; it is too small, the loop converges from {numbers['least']:.3g} on"
    enough = not advice.why_not and abs(advice.value) >= abs(numbers["least"])
    advised = f"= {advice.value:.3g}." if enough else f"beyond {numbers['least']:.3g}, or another form."
    name = case.controller.deformation.gain_name
    return Answer(GAIN, Verdict.NO, text, f"Use {name} {advised}", numbers)


QUESTIONS = (
    ControllerQuestion(_sign, ONE_SIGN, order=3),
    ControllerQuestion(_gain, GAIN, order=4, of_targets=True),
    ControllerQuestion(free_of_two_cycles, TWO_CYCLES, order=11, doubts=True),
)
