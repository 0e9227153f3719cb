"""How robust is the linear loop? Poles, and gain, phase and delay margin of each input's loop, opened where it enters the plant.

With z+ = F z + G w and v = C z (commands that arrive) the loop of input i is opened by w_i = w_i' - v_i:

    L_i(zeta) = -C_i (zeta I - F + G_i C_i)^-1 G_i,

all other loops closed. The deformation, dead time and prediction are in it.

References: K. J. Astrom, R. M. Murray, Feedback Systems, 2008, section 9.3, for the margins.
"""

from __future__ import annotations

import math
import warnings

import numpy as np

from fpirhc.problem import Problem
from fpirhc.studies.review.answer import Answer, Verdict
from fpirhc.studies.review.linear import LinearLoop
from fpirhc.studies.review.loops import Loops

QUESTION = "Has the linear loop enough margin?"
LEAST_GAIN = 1.4  # as a factor, up or down
LEAST_PHASE = 25.0  # degrees
_LARGEST = 120  # states of a loop whose margins are computed


def margins_enough(problem: Problem, loops: Loops) -> Answer:
    """Return the smallest margins of all inputs at the first, a middle and the last point of the reference."""
    if not loops.loops:
        return Answer(QUESTION, Verdict.UNKNOWN, f"no linear loop: {loops.reason}")
    if len(loops.loops[0].dynamics) > _LARGEST:
        text = f"largest |pole| {loops.radii.max():.6g}; margins of a loop of {len(loops.loops[0].dynamics)} states are not computed"
        return Answer(QUESTION, Verdict.UNKNOWN, text, "", {"radius": float(loops.radii.max())})
    chosen = {0, len(loops.loops) // 2, len(loops.loops) - 1}
    found = [margins(loops.loops[k], i) for k in sorted(chosen) for i in range(len(problem.plant.inputs))]
    gain, phase, delay = (min(column) for column in zip(*found, strict=True))
    radius = float(loops.radii.max())
    numbers = {"radius": radius, "gain_margin": gain, "phase_margin": phase, "delay_margin": delay}
    text = (
        f"largest |pole| {radius:.6g}; gain may change {gain:.3g} times, phase by {phase:.3g} deg, delay by {delay:.3g} s "
        f"({delay / problem.period:.3g} cycles)"
    )
    if radius >= 1:
        return Answer(QUESTION, Verdict.NO, f"{text}; a pole is outside the unit circle", "See the convergence and the rates.", numbers)
    good = gain >= LEAST_GAIN and phase >= LEAST_PHASE
    change = "" if good else "Lower the map's gain or the rate."
    return Answer(QUESTION, Verdict.YES if good else Verdict.UNKNOWN, text, change, numbers)


def margins(loop: LinearLoop, place: int) -> tuple[float, float, float]:
    """Return (gain margin as a factor >= 1 up or down, phase margin in degrees, delay margin in s) of one input's loop."""
    import control  # slow to import, and only margins need it

    g, c = loop.entry[:, [place]], loop.arriving[[place], :]
    opened = control.ss(loop.dynamics - g @ c, g, -c, np.zeros((1, 1)), loop.period)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # crossings at the Nyquist frequency are reported as warnings
        gains, phases, _, _, crossings, _ = control.stability_margins(opened, returnall=True)
    factors = [max(m, 1 / m) for m in np.atleast_1d(gains) if m > 0 and math.isfinite(m)]
    angles = [abs(float(p)) for p in np.atleast_1d(phases)]
    delays = [math.radians(p % 360) / w for p, w in zip(np.atleast_1d(phases), np.atleast_1d(crossings), strict=True) if w > 0]
    return min(factors, default=math.inf), min(angles, default=math.inf), min(delays, default=math.inf)
