"""How robust is the linear loop? By its poles, and the margins of gain, phase and delay of each input's loop, opened at the plant.

With z+ = F z + G w and v = C z (commands that arrive) the loop of input i is opened by w_i = w_i' - v_i:

    L_i(zeta) = -C_i (zeta I - F + G_i C_i)^-1 G_i,

all other loops closed. The deformation, dead time and prediction are in it. Plans that are not made in every cycle are judged over
the whole period from plan to plan, see `fpirhc.review.plan_period`.

References: K. J. Astrom, R. M. Murray, Feedback Systems, 2008, section 9.3, for the margins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy.linalg

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.linear import LinearLoop
from fpirhc.review.loops import Loops
from fpirhc.review.neutral import NEUTRAL
from fpirhc.review.plan_period import period_margins
from fpirhc.review.wording import duration
from fpirhc.simulation.linearise.linear_loop import LinearLoop as OverPeriod
from fpirhc.task.problem import Problem

QUESTION = "Has the linear loop enough margin?"
LEAST_GAIN = 1.4  # as a factor, up or down
LEAST_PHASE = 25.0  # degrees
_LARGEST = 400  # states of a loop whose margins are computed
_FREQUENCIES = 300
_LOWEST = 1e-5  # of the Nyquist frequency


def margins_enough(
    problem: Problem, loops: Loops, *, adapts: bool, planned: bool, whole: Sequence[OverPeriod] = ()
) -> Answer:
    """Return the smallest margins of all inputs at the first point of the reference and where the largest |pole| is.

    Args:
        problem: the problem.
        loops: linear loops of the controller.
        adapts: whether the controller has a deformation.
        planned: whether the controller is a plan, which has weights in place of a rate.
        whole: loops over a whole period of plans that are not made in every cycle; they are judged then.
    """
    every = whole or loops.loops
    if not every:
        return Answer(QUESTION, Verdict.UNKNOWN, f"no linear loop: {loops.reason}")
    radii = np.array([one.radius for one in every])
    radius = float(radii.max())
    text = f"largest closed-loop pole magnitude {radius:.6g}"
    if not whole and len(loops.loops[0].dynamics) > _LARGEST:
        text += f"; no margins of a loop of {len(loops.loops[0].dynamics)} states"
        return Answer(QUESTION, Verdict.UNKNOWN, text, "", {"radius": radius})
    if radius >= 1:  # there is no margin to lose
        return _outside(radii, text, {"radius": radius}, learns=loops.learns)
    places, inputs = sorted({0, int(np.argmax(radii))}), range(len(problem.plant.inputs))
    if whole:
        all_margins = [period_margins(whole[k], i) for k in places for i in inputs]
        text += f" per cycle, over the {len(whole[0].cycles)} cycles from plan to plan"
    else:
        all_margins = [margins(loops.loops[k], i) for k in places for i in inputs]
    gain, phase, delay = (min(column) for column in zip(*all_margins, strict=True))
    numbers = {"radius": radius, "gain_margin": gain, "phase_margin": phase, "delay_margin": delay}
    text += f"; {_sizes(gain, phase, delay, problem)}"
    if loops.learns:
        text += ", before the controller has learned anything"
    if any(one.hidden.any() for one in every):
        text += "; neutral modes that no judged coordinate shows are left out"
    good = gain >= LEAST_GAIN and phase >= LEAST_PHASE
    gentler = "weigh the inputs more" if planned else "lower the rate"
    change = "" if good else f"Lower the map's gain, or {gentler}." if adapts else f"{gentler.capitalize()}."
    return Answer(QUESTION, Verdict.YES if good else Verdict.UNKNOWN, text, change, numbers)


def _outside(radii: np.ndarray, text: str, numbers: dict[str, float], *, learns: bool) -> Answer:
    """The answer where the largest |pole| is at least 1."""
    smallest = float(radii.min())
    where = "all along" if smallest >= 1 else "at some points of"
    on_circle = float(radii.max()) < 1 + NEUTRAL
    text += f"; a pole is {'on' if on_circle else 'outside'} the unit circle {where} the reference"
    verdict = Verdict.NO if smallest >= 1 + NEUTRAL and not learns else Verdict.UNKNOWN
    return Answer(
        QUESTION, verdict, text, "See the rates, the zero dynamics, and the convergence of a deformation.", numbers
    )


def _sizes(gain: float, phase: float, delay: float, problem: Problem) -> str:
    """The margins in the units of the field."""
    factor = f"{gain:.3g} ({20 * math.log10(gain):.3g} dB)" if math.isfinite(gain) else "infinite"
    late = f"{duration(delay, problem)} ({delay / problem.period:.3g} cycles)" if math.isfinite(delay) else "infinite"
    return f"gain margin {factor}, phase margin {f'{phase:.3g} deg' if math.isfinite(phase) else 'infinite'}, delay margin {late}"


def margins(loop: LinearLoop, place: int) -> tuple[float, float, float]:
    """Return the margins of one input's loop.

    Args:
        loop: the linear loop.
        place: number of the input.

    Returns:
        Gain margin as a factor of at least 1, up or down; phase margin, degrees; delay margin, in the unit of time.
    """
    import control  # slow to import, and only margins need it

    nyquist = math.pi / loop.period
    frequencies = nyquist * np.geomspace(_LOWEST, 0.9999, _FREQUENCIES)
    values = _response(loop, place, np.append(frequencies, nyquist))
    opened = control.FrequencyResponseData(values[:-1], frequencies, loop.period)
    gains, phases, _, _, crossings, _ = control.stability_margins(opened, returnall=True)
    # At the Nyquist frequency, where most sampled loops leave the unit circle, L is real and crosses no phase.
    ends = [-1 / values[-1].real] if values[-1].real < 0 else []
    factors = [max(m, 1 / m) for m in [*np.atleast_1d(gains), *ends] if m > 0 and math.isfinite(m)]
    pairs = [
        (float(p), float(w)) for p, w in zip(np.atleast_1d(phases), np.atleast_1d(crossings), strict=True) if w > 0
    ]
    angles = [abs((p + 180) % 360 - 180) for p, _ in pairs]
    delays = [math.radians(p % 360) / w for p, w in pairs]
    return min(factors, default=math.inf), min(angles, default=math.inf), min(delays, default=math.inf)


def _response(loop: LinearLoop, place: int, frequencies: np.ndarray) -> np.ndarray:
    """L_i on the unit circle; from the matrices, because polynomials of so many states lose all digits."""
    g, c = loop.entry[:, place], loop.arriving[place]
    generator = loop.dynamics - np.outer(g, c)
    points = np.exp(1j * frequencies * loop.period)
    form, turn = scipy.linalg.schur(generator, output="complex")
    left, right, unit = c @ turn, turn.conj().T @ g, np.eye(len(form))
    return np.array([-left @ scipy.linalg.solve_triangular(point * unit - form, right) for point in points])
