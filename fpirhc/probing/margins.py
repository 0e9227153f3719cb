"""Margins of a loop on the estimated plant, at the corners of all intervals: the loop itself is linearised there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.deformation.base import Deformation
from fpirhc.errors import FpirhcError
from fpirhc.probing.estimated_plant import estimated_problem, gain_name
from fpirhc.probing.estimates import Estimates
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.task.problem import Problem

_STABLE = 1 - 1e-7
_FEW = 20  # cycles of the run along which a loop is linearised, beyond those that it takes to warm up


@dataclass(frozen=True)
class Corner:
    """A dead time and a lag of every input."""

    cycles: tuple[float, ...]
    lags: tuple[float, ...]


Case: TypeAlias = tuple[
    Corner, float, int
]  # a corner, a factor of the gains, and the number of a draw; 0: the estimate


class Margins:
    """Those of one controller with any deformation."""

    def __init__(self, problem: Problem, bare: Controller, estimates: Estimates) -> None:
        """Take the problem, the controller alone, and what is known of the plant."""
        self._problem, self._bare, self._estimates = problem, bare, estimates
        self._problems: dict[Corner, Problem] = {}
        self._loops: dict[tuple[Corner, Deformation | None], _Loop] = {}
        self._judged: dict[tuple[Deformation, bool], bool] = {}

    def safe(self, deformation: Deformation, *, rough: bool = False) -> bool:
        """Return whether the whole loop is stable in every case in which the controller alone is.

        Args:
            deformation: of the controller.
            rough: whether twice the gain and a slower plant are asked; else the gain margin of a review.
        """
        if (deformation, rough) not in self._judged:
            cases = self._far if rough else self._near
            self._judged[deformation, rough] = all(
                self._stable(deformation, case) for case in cases if self._stable(None, case)
            )
        return self._judged[deformation, rough]

    @cached_property
    def _near(self) -> tuple[Case, ...]:
        """A gain margin of 1.4 to both sides of the estimate and of a draw, and a command that is a cycle later."""
        dead, lag = self._estimates.dead, self._estimates.lag
        corners = dict.fromkeys(Corner(tuple(dead[i]), tuple(lag[j])) for i in (2, 0) for j in (0, 2))
        late = (Corner(tuple(dead[2] + 1), tuple(lag[1])), 1.0, 0)
        return late, *((corner, *case) for case in ((1.4, 0), (0.6, 0), (1.4, 1)) for corner in corners)

    @cached_property
    def _far(self) -> tuple[Case, ...]:
        """A lag is only a picture of what is slow: half as long again, and a command that is a cycle later."""
        dead, slow = self._estimates.dead[2], 1.5 * np.maximum(self._estimates.lag[2], 0.25 * self._problem.period)
        later = Corner(tuple(dead + 1), tuple(slow))
        return (later, 1.4, 0), (later, 1.4, 1), *((Corner(tuple(dead), tuple(slow)), 2.0, k) for k in (0, 1))

    def _stable(self, deformation: Deformation | None, case: Case) -> bool:
        corner, factor, draw = case
        return self._loop(corner, deformation).radius(factor, draw) < _STABLE

    def _loop(self, corner: Corner, deformation: Deformation | None) -> _Loop:
        """The loop at a corner; None: of the controller alone."""
        if corner not in self._problems:
            gains = self._estimates.gains
            self._problems[corner] = estimated_problem(self._problem, gains, corner.cycles, corner.lags)
        if (corner, deformation) not in self._loops:
            controller = self._bare if deformation is None else self._bare.with_deformation(deformation)
            self._loops[corner, deformation] = _Loop(self._problems[corner], controller, self._estimates)
        return self._loops[corner, deformation]


class _Loop:
    """A loop on the estimated plant, linearised for any gains."""

    def __init__(self, problem: Problem, controller: Controller, estimates: Estimates) -> None:
        self._matrices = (estimates.gains, *estimates.draws)
        self._radii: dict[tuple[float, int], float] = {}
        self._memory: np.ndarray | None = None
        try:
            self._loop = AskedLoop(problem, controller)
            self._memory = self._loop.quietest(self._loop.run(self._loop.start(), 4 * self._loop.warm + _FEW))
        except FpirhcError:  # it does not run
            return
        first, names = self._loop.loop.memory.slice("_exact").start, list(problem.real_plant.parameters)
        self._places = [first + names.index(gain_name(i, j)) for i, j in np.ndindex(estimates.gains.shape)]

    def radius(self, factor: float, draw: int) -> float:
        """Return the radius for a factor of the gains; infinite where the loop does not run."""
        if self._memory is None:
            return math.inf
        if (factor, draw) not in self._radii:
            changed = self._memory.copy()
            changed[self._places] = factor * self._matrices[draw].ravel()
            try:
                self._radii[factor, draw] = self._loop.at(changed).radius
            except FpirhcError:
                self._radii[factor, draw] = math.inf
        return self._radii[factor, draw]
