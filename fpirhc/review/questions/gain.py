"""Is the gain admissible? The map's own gain against the limits of the map and of its whole loop, and the recommended gain.

Half of the smallest limit of the whole loop is recommended, and every command that names a gain takes it from here. Theory:
docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.contraction.delayed import two_cycle_amplitudes, two_cycle_limit
from fpirhc.contraction.spectrum import ContractionReport, Spectrum, assess_gain
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved
from fpirhc.deformation.base import Deformation, innermost, own_gain
from fpirhc.errors import FpirhcError
from fpirhc.review.grid import is_late, review_grid
from fpirhc.review.loops import LoopsByGain, largest_product
from fpirhc.review.prediction import NominalRuns
from fpirhc.review.question import SEE_CONVERGENCE, Answer, Case, ControllerQuestion, Verdict, by_run
from fpirhc.review.questions.margins import keeps_margins, whose_loop
from fpirhc.review.questions.right_model import RIGHT_MODEL, leaves_right_model_alone
from fpirhc.review.questions.speed import fast_enough, gain_times, plan_keeps_up
from fpirhc.symbolic.evaluate import attempted
from fpirhc.task.problem import Problem

MARGIN = 2.0
SECANT, TWO_CYCLE = "the map's steepest secant", "a two-cycle of the whole loop"
POLES, MARGINS = "the poles of the whole loop", "the margins of the whole loop"
_ALONG, _DRAWN = 9, 8  # loops that are looked at
FAR = 10.0  # times a map's own gain, up to which a limit on targets is sought
_LEAST = 1e-3  # of the smallest other limit, down to which a stable gain is sought
_STEPS, _BISECTIONS = 24, 12
_OUTSIDE = "the model knows no {} of the plant outside"


@dataclass(frozen=True)
class Recommended:
    """A gain, and what sets it."""

    value: float  # of the map's own gain; NaN where none is recommended
    limit: float  # of the map's own gain, the smallest one
    sets: str  # which limit that is
    why_not: str = ""  # why none is recommended; empty where one is
    lowered: bool = False  # whether it is less than half of the limit, so that the loop keeps its margins
    exceeded: bool = False  # whether the gain in use is beyond the limit

    @property
    def text(self) -> str:
        """Limit and recommendation as the end of a sentence."""
        limit = f"the smallest limit is {self.limit:.3g}, set by {self.sets}; "
        if self.why_not:
            return f"{limit if math.isfinite(self.limit) else ''}no gain is recommended, because {self.why_not}"
        if self.lowered:
            return f"{limit}recommended {self.value:.3g}, with which {MARGINS} suffice"
        return f"{limit}recommended {self.value:.3g}, half of it"


def recommended_gain(
    deformation: Deformation, boxed: ContractionReport, share: float, loops: LoopsByGain | None
) -> Recommended:
    """Return the recommended gain of a map.

    Args:
        share: limit of gain times eigenvalue as a share of 2, below 1 behind a delay, an estimator or a filter.
        loops: its loops for every gain; None where no linear loop is known.
    """
    largest = share * max(map(abs, boxed.sector_limit))
    if not largest:
        return Recommended(math.nan, math.nan, "", "no gain converges all over the box")
    sign = math.copysign(1.0, sum(boxed.sector_limit))
    own = _own_per_effective(deformation)
    limits = {SECANT: largest, **(_limits_of_loop(deformation, loops, largest, sign) if loops else {})}
    sets = min(limits, key=lambda name: limits[name])
    gain = limits[sets] / MARGIN
    if loops and not _stable(loops, sign * gain):
        why = f"with {sign * gain * own:.3g}, half of it, the loop does not converge"
        return Recommended(math.nan, sign * limits[sets] * own, sets, why)
    size = gain if loops is None else _with_margins(loops, sign * gain)
    return Recommended(sign * size * own, sign * limits[sets] * own, sets, lowered=size < gain)


def secant_limit(loops: LoopsByGain) -> float | None:
    """Return the smallest secant gain with which the loop has a two-cycle along the reference; None where it is not known.

    Between plans a loop alternates from cycle to cycle, so plans are held.
    """
    try:
        return min(two_cycle_limit(low.dynamics, own.dynamics, loops.gains) for low, own in loops.held(_ALONG))
    except (FpirhcError, np.linalg.LinAlgError):
        return None


def limit_of_loop(deformation: Deformation, loops: LoopsByGain) -> tuple[float, str]:
    """Return the smallest effective gain that is a limit of the whole loop, up to `FAR` times the map's own, and what sets it.

    Infinite where there is none; NaN where no gain down to a hundredth of the map's own converges.
    """
    own = deformation.effective_gain()
    size, sign = abs(own), math.copysign(1.0, own)
    limits = dict(_limits_of_loop(deformation, loops, FAR * size, sign))
    if not limits and not _stable(loops, sign * FAR * size):
        return math.nan, ""
    sets = min(limits, key=lambda name: limits[name], default="")
    limit = limits[sets] if sets else math.inf
    return (sign * limit, sets) if limit <= FAR * size else (math.inf, "")


def least_gain(loops: LoopsByGain, limit: float) -> float | None:
    """Return the smallest effective gain with which the loop converges along the reference, where that of the map is too small.

    None where the loop converges with the map's gain, or with none between it and the limit.
    """
    own, along = loops.gains[1], loops.along(_ALONG)
    if loops.all_stable(own, along) or not abs(own) < abs(limit):
        return None
    gains = math.copysign(1.0, own) * np.geomspace(abs(own), abs(limit), _STEPS)
    first = next((k for k, gain in enumerate(gains) if loops.all_stable(float(gain), along)), None)
    if first is None:
        return None
    low, high = float(gains[first - 1]), float(gains[first])
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if loops.all_stable(middle, along) else (middle, high)
    return high


def _limits_of_loop(deformation: Deformation, loops: LoopsByGain, most: float, sign: float) -> Mapping[str, float]:
    limits = {}
    secant = secant_limit(loops)
    if secant is not None and math.isfinite(secant):
        right = deformation.with_effective_gain(sign * most)
        limits[TWO_CYCLE] = secant * most / abs(right.secant_gain())
    poles = _pole_limit(loops, sign, min([most, *limits.values()]))
    return limits if poles is None else {**limits, POLES: poles}


def _pole_limit(loops: LoopsByGain, sign: float, most: float) -> float | None:
    """Largest stable gain below the other limits; None where the poles set none below them."""
    if _stable(loops, sign * most):
        return None
    gains = most * np.geomspace(1.0, _LEAST, _STEPS)
    first = next((k for k, gain in enumerate(gains) if _stable(loops, sign * float(gain))), None)
    if first is None:
        return None  # nothing converges, which half of the other limits shows
    low, high = float(gains[first]), float(gains[first - 1])
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _stable(loops, sign * middle) else (low, middle)
    return low


def _stable(loops: LoopsByGain, gain: float) -> bool:
    return loops.all_stable(gain, (*loops.along(_ALONG), *loops.over_box(_DRAWN)))


def _with_margins(loops: LoopsByGain, gain: float) -> float:
    """The size of the gain, or of the largest smaller one that keeps the margins; itself where smaller ones do not help."""
    pair = max(loops.along(_ALONG), key=lambda pair: loops.at(gain, pair).radius)
    for share in np.geomspace(1.0, 1 / MARGIN**2, 8):
        loop = loops.at(float(share) * gain, pair)
        if all(keeps_margins(loop, i) for i in range(loop.cycles[0].entry.shape[1])):
            return abs(gain) * float(share)
    return abs(gain)


def _own_per_effective(deformation: Deformation) -> float:
    return own_gain(deformation)[1] / deformation.effective_gain()


def gain_advice(case: Case, boxed: Spectrum, null: Answer | None) -> Recommended:
    """Return the recommended gain of a controller; none where it fails the null test, where a run with that gain
    does harm, and for a plant outside.

    Where its own gain is beyond the limits, the null test of a gain within them counts.

    Args:
        boxed: eigenvalues of the response Jacobian over the box of parameters.
        null: the answer whether adaptation leaves a right model alone.
    """
    deformation = case.controller.deformation
    report = assess_gain(deformation, boxed)
    share = largest_product(case.problem, deformation, boxed.eigenvalues) / 2
    low, high = (share * end for end in report.sector_limit)
    if low < high and not low < deformation.effective_gain() < high:
        safe = _case_with(case, 0.5 * (low + high))
        return replace(gain_advice(safe, boxed, leaves_right_model_alone(safe)), exceeded=True)
    advice = recommended_gain(deformation, report, share, case.by_gain)
    if advice.why_not:
        return advice
    size, limit = (value / _own_per_effective(deformation) for value in (advice.value, advice.limit))
    if null is not None and null.verdict == Verdict.NO and abs(deformation.effective_gain()) >= abs(limit):
        null = leaves_right_model_alone(_case_with(case, size))
    if null is not None and null.verdict == Verdict.NO:
        against = "adaptation does not leave a right model alone"
    elif case.grid.outside:
        against = _OUTSIDE.format(_not_stated(case.problem)[0])
    else:
        harm = case.harm(deformation.with_effective_gain(size))
        against = f"with {advice.value:.3g}, half of it, {harm}" if harm else ""
    return replace(advice, value=math.nan, why_not=against) if against else advice


def recommended_for(problem: Problem, controller: Controller) -> Recommended | None:
    """Return the gain that a review of a controller recommends, also where its own gain is refused; None where it has no answer."""
    try:
        grid = review_grid(problem, 0.0, 0)
        ready = resolved(grid.problem, controller)
        case = Case(grid, ready, NominalRuns(grid.problem))
        return gain_advice(case, case.spectrum(grid.draws), leaves_right_model_alone(case))
    except FpirhcError:
        return None


def _case_with(case: Case, gain: float) -> Case:
    """The case of the controller with another effective gain."""
    deformation = case.controller.deformation.with_effective_gain(gain)
    controller = resolved(case.problem, case.controller.with_deformation(deformation))
    return Case(case.grid, controller, case.runs)


def reviewed_gain(problem: Problem, controller: Controller, *, grows: bool) -> str:
    """Return what a review says of the gain: the recommended one where errors grow, else whether it is too small, else nothing.

    `grows`: whether the iteration is no contraction along the run.
    """
    if controller.deforms == "target" or not controller.deformation.adapts:
        return ""
    if grows:
        advice = recommended_for(problem, controller)
        return "" if advice is None else f"Its gain{' is too large' if advice.exceeded else ''}: {advice.text}."
    answer = attempted("the speed of the iteration", _speed, problem, controller, broken=[])
    if answer is None or answer.verdict is not Verdict.NO:
        return ""
    return f"Its gain is too small: {answer.evidence}. {answer.change}"


def _speed(problem: Problem, controller: Controller) -> Answer | None:
    grid = review_grid(problem, 0.0, 0)
    case = Case(grid, controller, NominalRuns(grid.problem))
    return fast_enough(case) or plan_keeps_up(case)


GAIN = "Is the map's gain admissible?"
NO_GAIN = "Use another form, or leave the deformation out."


def gain_admissible(
    deformation: Deformation, own: Spectrum, boxed: Spectrum, limit: float, advice: Recommended
) -> Answer:
    """Return the interval of admissible gains and the recommended value.

    Args:
        own: eigenvalues of the response Jacobian along the reference, with the exact parameters.
        limit: limit of gain times eigenvalue, 2 without dead time.
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
    verdict = Verdict.UNKNOWN if advice.why_not else Verdict.CAUTION
    return Answer(GAIN, Verdict.YES if good else verdict, text, change, numbers)


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
        text += f"no gain up to {FAR:g} times as large is a limit of the whole loop{whose_loop(case)}"
        return Answer(GAIN, Verdict.YES, text, "", numbers)
    text += f"the smallest limit is {limit * scale:.3g}, set by {sets}{whose_loop(case)}"
    along = case.loops.radii.max() < 1  # in the box it is another matter
    verdict = Verdict.YES if value / limit < 1 else Verdict.CAUTION if along else Verdict.NO
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
    verdict = Verdict.NO if not own.one_sign else Verdict.YES if boxed.one_sign else Verdict.CAUTION
    return Answer(ONE_SIGN, verdict, text, change, numbers)


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
    lacks, them = _not_stated(case.problem)
    if answer.verdict == Verdict.UNKNOWN and advice.why_not == _OUTSIDE.format(lacks):
        return replace(answer, change=f"fpirhc probe measures {them} and recommends a gain.")
    return _helping(case, answer)


def _not_stated(problem: Problem) -> tuple[str, str]:
    """What nobody states of a plant outside whose lag is not stated, and its pronoun."""
    return ("lag", "it") if is_late(problem) else ("lag and no latency", "them")


def _helping(case: Case, answer: Answer) -> Answer:
    """The answer, or yes where a run with the gain in use, inside its limits, is better, though the recommended one did harm."""
    null = case.answer(RIGHT_MODEL)
    inside = 0 < answer.numbers["gain"] / answer.numbers["limit"] < 1 if answer.verdict == Verdict.UNKNOWN else False
    if not inside or (null is not None and null.verdict == Verdict.NO):
        return answer
    ran = by_run(case, GAIN, answer.evidence)
    return replace(ran, numbers={**answer.numbers, **ran.numbers}) if ran.verdict == Verdict.YES else answer


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
