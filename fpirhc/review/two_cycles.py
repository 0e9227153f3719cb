"""Can a large error end in a bounded two-cycle? It can, where the map's secant reaches the limit of the whole loop."""

from __future__ import annotations

import math

import numpy as np

from fpirhc.contraction import two_cycle_amplitudes, two_cycle_limit
from fpirhc.controllers.base import Controller
from fpirhc.deformation.base import Deformation, innermost
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import Loops, loops_at

QUESTION = "Is it free of bounded two-cycles?"
_POINTS = 9  # of the reference
_LOWER = 0.9  # gain of the second loop, as a share of the map's own


def free_of_two_cycles(grid: ReviewGrid, controller: Controller, loops: Loops) -> Answer | None:
    """Return the map's secant gain beside the smallest that makes a two-cycle along the reference.

    The answer is None without linear loops, and where the response is late: there longer cycles come first.
    """
    if grid.problem.response_delay > 0:
        return None
    deformation = controller.deformation
    gain = deformation.effective_gain()
    lower = _with_gain(controller, _LOWER * gain)
    if not loops.loops or not deformation.constant or lower is None:
        return None
    points = np.unique(np.linspace(0, len(loops.places) - 1, _POINTS).astype(int))
    try:
        others = loops_at(grid, lower, [loops.places[k] for k in points])
        pairs = zip((loops.loops[k] for k in points), others, strict=True)
        limit = min(two_cycle_limit(b.dynamics, a.dynamics, (_LOWER * gain, gain)) for a, b in pairs)
    except (FpirhcError, np.linalg.LinAlgError):
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
    change = f"Multiply the gain by less than {limit / secant:.3g}."
    return Answer(QUESTION, Verdict.NO, text, change, numbers)


def _amplitudes(map_: Deformation, limit: float) -> tuple[float, ...]:
    """Sizes of the error in two-cycles of a map with one secant for all directions; empty where they are not known."""
    step = map_.largest_step()
    if not math.isfinite(step):
        return ()
    try:
        return two_cycle_amplitudes(map_, limit, size=step)
    except FpirhcError:
        return ()


def _with_gain(controller: Controller, gain: float) -> Controller | None:
    """The controller with another effective gain of its deformation; None where it cannot be set."""
    try:
        return controller.with_deformation(controller.deformation.with_effective_gain(gain))
    except FpirhcError:
        return None
