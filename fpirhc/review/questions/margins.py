"""How robust is the linear loop? By its poles, and the margins of gain, phase and delay of each input's loop, opened at the plant.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fpirhc.review.loops import Loops, is_planned
from fpirhc.review.question import Answer, Case, ControllerQuestion, Verdict, duration
from fpirhc.simulation.linearise.linear_loop import NEUTRAL, LinearLoop
from fpirhc.task.problem import Problem

MARGINS = "Has the linear loop enough margin?"
LEAST_GAIN = 1.4  # as a factor, up or down
LEAST_PHASE = 25.0  # degrees
_LARGEST = 400  # states of a loop whose margins are computed
_FREQUENCIES = 300
_PER_TURN = 4  # frequencies for half a turn of the longest delay line
_LOWEST = 1e-5  # of the Nyquist frequency
_REAL = 1e-2  # share of an imaginary part with which L is real at rest; one that is large there has an integrator
_DECADES = math.log(1e3)  # of the gain margins that are looked for over a period
_STEPS, _TOGETHER = 60, 5
_ITERATIONS = 60  # of a root
_LOWER = "Lower the map's gain"
_PASSING = (
    "Use a form that passes the desired response at once (ModelReferenced, Increment)"  # a lower gain is later still
)
SLOWER = (
    "Let it learn more slowly (a smaller drift of disturbances, a longer memory, a smaller gain of adaptation), or mend "
    "the model."
)


def margins_enough(problem: Problem, loops: Loops, *, adapts: bool, planned: bool, learner: bool = False) -> Answer:
    """Return the smallest margins of all inputs at the first point of the reference and where the largest |pole| is.

    Where plans are not made in every cycle they are those of all points.

    Args:
        adapts: whether the controller has a deformation.
        planned: whether the controller is a plan, which has weights in place of a rate.
        learner: whether its model changes in a run.
    """
    if not loops.loops:
        return Answer(MARGINS, Verdict.UNKNOWN, f"no linear loop: {loops.reason}")
    first, radius = loops.loops[0], float(loops.radii.max())
    text = f"largest closed-loop pole magnitude {radius:.6g}"
    size = first.cycles[0].dynamics.shape[1]
    if size > _LARGEST:
        text += f"; no margins of a loop of {size} states"
        return Answer(MARGINS, Verdict.UNKNOWN, text, "", {"radius": radius})
    if radius >= 1:  # there is no margin to lose
        change = SLOWER if learner else _poles_advice(loops, adapts)
        return replace(_outside(loops.radii, text, {"radius": radius}, learns=loops.learns), change=change)
    # Loops of plans are few, and differ more.
    places = range(len(loops.loops)) if len(first.cycles) > 1 else sorted({0, int(np.argmax(loops.radii))})
    if len(first.cycles) > 1:
        text += f" per cycle, over the {len(first.cycles)} cycles from plan to plan"
    said, sizes = smallest_margins([loops.loops[k] for k in places], problem)
    numbers, text = {"radius": radius, **sizes}, f"{text}; {said}"
    gain, phase = sizes["gain_margin"], sizes["phase_margin"]
    if loops.learns:
        text += ", before the controller has learned anything"
    if any(one.hidden.any() for one in loops.loops):
        text += "; neutral modes that no judged coordinate shows are left out"
    good = gain >= LEAST_GAIN and phase >= LEAST_PHASE
    gentler = "weigh the inputs more" if planned else "lower the rate"
    change = SLOWER if learner else f"{_LOWER}, or {gentler}." if adapts else f"{gentler.capitalize()}."
    return Answer(MARGINS, Verdict.YES if good else Verdict.CAUTION, text, change, numbers)


def smallest_margins(loops: Sequence[LinearLoop], problem: Problem) -> tuple[str, dict[str, float]]:
    """Return the smallest margins of the inputs of some loops, in words and as numbers; nothing of loops that are too large."""
    if max(one.cycles[0].dynamics.shape[1] for one in loops) > _LARGEST:
        return "", {}
    sizes = [margins(one, i) for one in loops for i in range(len(problem.plant.inputs))]
    gain, phase, delay = (float(min(column)) for column in zip(*sizes, strict=True))
    return _sizes(gain, phase, delay, problem), {"gain_margin": gain, "phase_margin": phase, "delay_margin": delay}


def _poles_advice(loops: Loops, adapts: bool) -> str:
    """Which other answer has the cause: the loop with the right model, the deformation, or else the wrong model."""
    if loops.ideal is None or loops.ideal.radius >= 1:
        return "See the rates and the zero dynamics."
    right = "With a right model and no adaptation the loop converges"
    return f"{right}: see the convergence of the deformation." if adapts else f"{right}: mend the model, or adapt."


def _outside(radii: np.ndarray, text: str, numbers: dict[str, float], *, learns: bool) -> Answer:
    """The answer where the largest |pole| is at least 1."""
    smallest = float(radii.min())
    where = "all along" if smallest >= 1 else "at some points of"
    on_circle = float(radii.max()) < 1 + NEUTRAL
    text += f"; a pole is {'on' if on_circle else 'outside'} the unit circle {where} the reference"
    verdict = Verdict.UNKNOWN if learns else Verdict.NO if smallest >= 1 + NEUTRAL else Verdict.CAUTION
    return Answer(MARGINS, verdict, text, "", numbers)


def _sizes(gain: float, phase: float, delay: float, problem: Problem) -> str:
    """The margins in the units of the field."""
    factor = f"{gain:.3g} ({20 * math.log10(gain):.3g} dB)" if math.isfinite(gain) else "infinite"
    late = f"{duration(delay, problem)} ({delay / problem.period:.3g} cycles)" if math.isfinite(delay) else "infinite"
    return f"gain margin {factor}, phase margin {f'{phase:.3g} deg' if math.isfinite(phase) else 'infinite'}, delay margin {late}"


def margins(loop: LinearLoop, place: int) -> tuple[float, float, float]:
    """Return the margins of one input's loop.

    Returns:
        Gain margin as a factor of at least 1, up or down; phase margin, degrees; delay margin, in the unit of time.
    """
    if len(loop.cycles) > 1:
        return _of_a_period(loop, place)
    nyquist = math.pi / loop.period
    turns = _PER_TURN * loop.longest
    fine = np.arange(1, turns) / max(turns, 1)
    frequencies = nyquist * np.union1d(np.append(np.geomspace(_LOWEST, 0.9999, _FREQUENCIES), 1.0), fine)
    opened = loop.opened(place)
    values = opened(frequencies)
    turned = opened(_roots(lambda w: opened(w).imag, frequencies[:-1], values[:-1].imag))
    # At rest and at the Nyquist frequency, where most sampled loops leave the unit circle, L is real and crosses no phase.
    ends = values[[0, -1]] if abs(values[0].imag) < _REAL * abs(values[0]) < 1 else values[-1:]
    gains = [-1 / value.real for value in (*turned, *ends) if value.real < 0]
    factors = [max(gain, 1 / gain) for gain in gains]
    crossings = _roots(lambda w: np.abs(opened(w)) - 1, frequencies, np.abs(values) - 1)
    phases = np.angle(-opened(crossings))
    delays = [(phase % (2 * math.pi)) / w for phase, w in zip(phases, crossings, strict=True)]
    least = min((abs(math.degrees(phase)) for phase in phases), default=math.inf)
    return min(factors, default=math.inf), least, min(delays, default=math.inf)


def keeps_margins(loop: LinearLoop, place: int) -> bool:
    """Whether the margins of one input's loop are the least that are wanted, without the search for their sizes."""
    if len(loop.cycles) == 1:
        gain, phase, _ = margins(loop, place)
        return gain >= LEAST_GAIN and phase >= LEAST_PHASE
    most, angle = math.log(LEAST_GAIN), math.radians(LEAST_PHASE)
    factors = [*np.exp(_up_to(most, _DECADES)), *np.exp(-_up_to(most, _DECADES)), *np.exp(-1j * _up_to(angle, math.pi))]
    poles = _turning(loop, place)
    return all(bool((np.abs(poles(np.array([factor]))) < 1).all()) for factor in factors)


def _up_to(end: float, most: float) -> np.ndarray:
    """The steps at which margins up to `most` are looked for, as far as an end, and the end."""
    steps = np.linspace(0, most, _STEPS + 1)
    return np.append(steps[steps < end], end)


def _roots(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Arguments at which a function is zero, one between each pair of neighbours of different signs."""
    changes = np.flatnonzero(np.sign(values[1:]) * np.sign(values[:-1]) < 0)
    ends = at[changes], at[changes + 1]
    return _between(function, ends, (values[changes], values[changes + 1]), 1e-9)


def _between(
    function: Callable[[np.ndarray], np.ndarray],
    ends: tuple[np.ndarray, np.ndarray],
    values: tuple[np.ndarray, np.ndarray],
    tolerance: float,
) -> np.ndarray:
    """Roots between ends (m,) of different signs, together, by false position with half a value at an end that stays.

    G. Dahlquist, A. Bjorck, Numerical Methods, 1974, section 6.6, the Illinois method. That of scipy takes one root at a time, and
    its import takes longer than a review's margins.
    """
    (old, new), (f_old, f_new) = ends, values
    for _ in range(_ITERATIONS):
        if (np.abs(new - old) <= tolerance * np.abs(new)).all():
            break
        between = new - f_new * (new - old) / np.where(f_new == f_old, 1.0, f_new - f_old)
        f = function(between)
        crossed = np.sign(f) * np.sign(f_new) <= 0
        old, f_old = np.where(crossed, new, old), np.where(crossed, f_new, f_old / 2)
        new, f_new = between, f
    return new


def _of_a_period(loop: LinearLoop, place: int) -> tuple[float, float, float]:
    """Margins of a loop with plans every n cycles: the smallest factor of the command, real or on the unit circle, with |pole| = 1.

    A mode turns by at most pi in a period, so the delay of a turned command follows from the turn of the mode.
    """
    turned = _turning(loop, place)
    up = _first(lambda x: turned(np.exp(x)), _DECADES)
    down = _first(lambda x: turned(np.exp(-x)), _DECADES, up)
    angle = _first(lambda x: turned(np.exp(-1j * x)), math.pi)
    poles = turned(np.exp([-1j * angle]))[0] if math.isfinite(angle) else np.ones(1)
    turns = np.angle(poles[np.abs(np.abs(poles) - 1) < 1e-3])
    fastest = float(np.abs(turns).max(initial=0.0)) / (len(loop.cycles) * loop.period)
    return math.exp(min(up, down)), math.degrees(angle), angle / fastest if fastest else math.inf


def _turning(loop: LinearLoop, place: int) -> Callable[[np.ndarray], np.ndarray]:
    """Function factors -> poles (factors, poles) when a command is multiplied, without those of no fault of the loop.

    Over a period z -> A z + B u and v = C z + D u, where v are the values of the command in its cycles and u what is added to them.
    With u = (factor - 1) v, the period's map is A + B (1 / (factor - 1) - D)^-1 C.
    """
    whole: np.ndarray = np.eye(loop.dynamics.shape[1])
    added, shown, through = np.zeros((len(whole), 0)), [], np.zeros((len(loop.cycles), len(loop.cycles)))
    for k, one in enumerate(loop.cycles):
        command = one.arriving[place]
        shown.append(command @ whole)
        through[k, :k] = command @ added
        added, whole = np.column_stack([one.dynamics @ added, one.entry[:, place]]), one.dynamics @ whole
    faultless = loop.poles[loop.hidden]

    def poles_of(factors: np.ndarray) -> np.ndarray:
        more = (factors - 1)[:, None, None]
        poles = np.linalg.eigvals(
            whole + added @ np.linalg.solve(np.eye(len(shown)) - more * through, more * np.array(shown))
        )
        for hidden in faultless:
            nearest = np.argmin(np.abs(poles - hidden), axis=1)
            others = np.arange(poles.shape[1]) != nearest[:, None]
            poles = poles[others].reshape(len(poles), -1)
        return np.asarray(poles)

    return poles_of


def _first(poles: Callable[[np.ndarray], np.ndarray], most: float, enough: float = math.inf) -> float:
    """The smallest argument up to `most` where a pole leaves the unit circle; infinite where none does.

    No step beyond `enough` is looked at.
    """

    def outside(x: np.ndarray) -> np.ndarray:
        return np.asarray(np.abs(poles(x)).max(axis=1, initial=0.0)) - 1

    steps, values = np.linspace(0, most, _STEPS + 1), np.empty(0)
    steps = steps[: np.searchsorted(steps, enough) + 1]
    while len(values) < len(steps):
        values = np.append(values, outside(steps[len(values) : len(values) + _TOGETHER]))
        beyond = np.flatnonzero(values >= 0)
        if beyond.size:
            k = int(beyond[0])
            some = slice(k - 1, k), slice(k, k + 1)
            ends, sizes = (steps[some[0]], steps[some[1]]), (values[some[0]], values[some[1]])
            return float(_between(outside, ends, sizes, 1e-6)[0]) if k else 0.0
    return math.inf


def whose_loop(case: Case) -> str:
    """The end of a sentence about a linear loop: that the reality is not in it, where there is one."""
    return "" if case.grid.real is None else "; of the model by itself, without the reality"


def _asked(case: Case) -> Answer | None:
    if not case.feeds_back:
        return None
    adapts, planned = case.controller.deformation.adapts, is_planned(case.controller)
    answer = margins_enough(case.problem, case.loops, adapts=adapts, planned=planned, learner=case.controller.learns)
    alone = whose_loop(case)
    if alone and math.isfinite(answer.numbers.get("delay_margin", math.inf)):
        alone += ", whose lags and latencies together have to stay below the delay margin"
    answer = replace(answer, evidence=f"{answer.evidence}{alone}")
    late = adapts and case.controller.deformation.iteration.slows_desired
    return replace(answer, change=answer.change.replace(_LOWER, _PASSING, 1)) if late else answer


QUESTIONS = (ControllerQuestion(_asked, MARGINS, order=22, adaptive=False),)
