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
from fpirhc.simulation.linearise.linear_loop import NEUTRAL, LinearCycle, LinearLoop

LITTLE = 0.1  # growth over the run, as a share, that it does not show
_ROUNDING = 1e-5  # of the radius of a neutral mode
_SHARES = (0.1, 0.5, 1.0, 2.0)  # of the map's own gain, at which a mode that no gain changes is looked for
_LOWER = 0.9  # the lower gain, as a share of the map's own

Pair: TypeAlias = tuple[LinearLoop, LinearLoop]


class LoopsByGain:
    """Loops of a map at its own gain and at a lower one, in the same coordinates.

    Args:
        points: of the loop.
        own: points and draws that are looked at.
        gain: effective gain of the map.
        cycles: of the run.
    """

    def __init__(self, points: Points, own: Loops, gain: float, cycles: int) -> None:
        self._points, self._own, self.gains = points, own, (_LOWER * gain, gain)
        self._most = (1 + LITTLE) ** (1 / cycles)
        self._pair, self._floor = cache(self._between), cache(self._least)

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

    def stable(self, gain: float, pair: Pair) -> bool:
        """Whether no mode grows with an effective gain but one that grows with all of them, too little to show in the run."""
        radius = self.at(gain, pair).radius
        return radius < 1 + NEUTRAL or radius < min(self._most, self._floor(pair) + _ROUNDING)

    def _least(self, pair: Pair) -> float:
        return min(self.at(share * self.gains[1], pair).radius for share in _SHARES)

    def _between(self, place: int, draw: int, held: bool) -> Pair:
        low, own = self._points.between(place, draw, self.gains, held=held)
        return low, own


def loops_by_gain(grid: ReviewGrid, controller: Controller, own: Loops) -> LoopsByGain | None:
    """Return the loops for every gain; None without loops, and for a map that changes or has no gain to set."""
    if not controller.deformation.adapts or not controller.deformation.iteration.constant or not own.places:
        return None
    loops = LoopsByGain(points_of(grid, controller), own, controller.deformation.effective_gain(), grid.problem.cycles)
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
