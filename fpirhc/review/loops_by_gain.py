"""The linear loops of a controller for every gain of its map: their matrices are affine in the gain, so two gains give all.

F(a) = F(a1) + (a - a1) / (a1 - a2) (F(a1) - F(a2)),      a the effective gain; G and C likewise, in every cycle of a period.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TypeAlias

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import Loops, Points, points_of, thinned
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop

_LOWER = 0.9  # the lower gain, as a share of the map's own

Pair: TypeAlias = tuple[LinearLoop, LinearLoop]


class LoopsByGain:
    """Loops of a map at its own gain and at a lower one, in the same coordinates.

    Args:
        points: of the loop.
        own: points and draws that are looked at.
        gain: effective gain of the map.
    """

    def __init__(self, points: Points, own: Loops, gain: float) -> None:
        self._points, self._own, self.gains = points, own, (_LOWER * gain, gain)
        self._pair = cache(self._between)

    def along(self, most: int) -> list[Pair]:
        """Return (lower, own) at no more than so many points of the reference, with the exact parameters."""
        return [self._pair(k, 0, False) for k in thinned(self._own.places, most)]

    def held(self, most: int) -> list[Pair]:
        """Return (lower, own) at no more than so many points of the reference, with plans that are held for ever."""
        return [self._pair(k, 0, True) for k in thinned(self._own.places, most)]

    def over_box(self, most: int) -> list[Pair]:
        """Return (lower, own) for no more than so many draws of the parameters."""
        return [self._pair(*one, False) for one in thinned(self._own.draws, most)]

    def at(self, gain: float, pair: Pair) -> LinearLoop:
        """Return the loop at another effective gain."""
        low, own = pair
        share = (gain - self.gains[1]) / (self.gains[1] - self.gains[0])
        cycles = (_mixed(one, other, share) for one, other in zip(own.cycles, low.cycles, strict=True))
        return replace(own, cycles=tuple(cycles))

    def _between(self, place: int, draw: int, held: bool) -> Pair:
        low, own = self._points.between(place, draw, self.gains, held=held)
        return low, own


def loops_by_gain(grid: ReviewGrid, controller: Controller, own: Loops) -> LoopsByGain | None:
    """Return the loops for every gain; None without loops, and for a map that changes or has no gain to set."""
    if not controller.deformation.adapts or not controller.deformation.iteration.constant or not own.places:
        return None
    loops = LoopsByGain(points_of(grid, controller), own, controller.deformation.effective_gain())
    try:
        loops.along(1)
    except (FpirhcError, np.linalg.LinAlgError):
        return None
    return loops


def _mixed(first: LinearCycle, second: LinearCycle, share: float) -> LinearCycle:
    def mixed(name: str) -> np.ndarray:
        one, other = getattr(first, name), getattr(second, name)
        return np.asarray(one + share * (one - other))

    return replace(first, dynamics=mixed("dynamics"), entry=mixed("entry"), arriving=mixed("arriving"))
