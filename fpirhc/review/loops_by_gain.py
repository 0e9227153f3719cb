"""The linear loops of a controller for every gain of its map: their matrices are affine in the gain, so two gains give all.

F(a) = F(a1) + (a - a1) / (a1 - a2) (F(a1) - F(a2)),      a the effective gain; G and C likewise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.linear import LinearLoop
from fpirhc.review.loops import Loops, loops_along

_LOWER = 0.9  # gain of the second loops, as a share of that of the first
_SHARES = (1.0, 0.5, 0.1)  # of the map's own gain, at which the first loops are sought


class LoopsByGain:
    """Loops of a map at its own gain and at a lower one.

    Args:
        own: loops of the map.
        lower: loops at the lower gain.
        gain: effective gain of the map.
    """

    def __init__(self, own: Loops, lower: Loops, gain: float) -> None:
        self.own, self.lower, self.gain = own, lower, gain
        self.gains = _LOWER * gain, gain

    def along(self, most: int) -> list[tuple[LinearLoop, LinearLoop]]:
        """Return (lower, own) at no more than so many points of the reference, with the exact parameters."""
        return _some(list(zip(self.lower.loops, self.own.loops, strict=True)), most)

    def over_box(self, most: int) -> list[tuple[LinearLoop, LinearLoop]]:
        """Return (lower, own) for no more than so many draws of the parameters."""
        return _some(list(zip(self.lower.drawn, self.own.drawn, strict=True)), most)

    def at(self, gain: float, pair: tuple[LinearLoop, LinearLoop]) -> LinearLoop:
        """Return the loop at another effective gain."""
        low, own = pair
        share = (gain - self.gain) / (self.gain - self.gains[0])

        def mixed(name: str) -> np.ndarray:
            first, second = getattr(own, name), getattr(low, name)
            return np.asarray(first + share * (first - second))

        return replace(own, dynamics=mixed("dynamics"), entry=mixed("entry"), arriving=mixed("arriving"))


def loops_by_gain(grid: ReviewGrid, controller: Controller, own: Loops) -> LoopsByGain | None:
    """Return the loops for every gain; None without loops, and for a map that changes or has no gain to set.

    A gain that the linearised plants refuse has no loops, so there those of smaller gains are taken.
    """
    if not controller.deformation.adapts or not controller.deformation.iteration.constant:
        return None
    gain = controller.deformation.effective_gain()
    for share in _SHARES:
        first = own if share == 1 else _at(grid, controller, share * gain)
        lower = _at(grid, controller, _LOWER * share * gain) if first.loops else first
        if lower.loops and _sizes(lower) == _sizes(first):
            return LoopsByGain(first, lower, share * gain)
    return None


def _at(grid: ReviewGrid, controller: Controller, gain: float) -> Loops:
    """The loops at another effective gain; none where it cannot be set."""
    try:
        return loops_along(grid, controller.with_deformation(controller.deformation.with_effective_gain(gain)))
    except FpirhcError as error:
        return Loops((), (), None, reason=str(error))


def _sizes(loops: Loops) -> list[tuple[int, ...]]:
    """Shapes of all loops; they differ where a gain leaves other entries of the memory at rest."""
    return [one.dynamics.shape for one in (*loops.loops, *loops.drawn)]


def _some(pairs: list[tuple[LinearLoop, LinearLoop]], most: int) -> list[tuple[LinearLoop, LinearLoop]]:
    return [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, most).astype(int))] if pairs else []
