"""A map as it is near its fixed point, r+ = r - a W (f - d), with the gain a in its memory.

Every map is this one to first order. The loop of one map for every gain is then one loop with other memories, affine in a.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from fpirhc.controllers.base import Controller
from fpirhc.deformation.base import Deformation, Iteration, with_inner
from fpirhc.errors import FpirhcError
from fpirhc.symbolic.layout import Expression, Layout, scalar

GAIN = "map_gain"  # in the memory


@dataclass(frozen=True)
class LinearMap(Deformation):
    """r+ = r - a W (f - d).

    Args:
        gain: a at the start.
        weights: W by rows; None: the one matrix.
    """

    gain: float
    weights: tuple[tuple[float, ...], ...] | None = None

    @property
    def iteration(self) -> Iteration:
        """Of no limit, because a gain that a run refuses has poles too."""
        return Iteration(limited=False, weights=self.weights)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        del elements
        return Layout((scalar(GAIN, start=self.gain),))

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        error = response - desired
        weighted = error if self.weights is None else ca.DM(self.weights) @ error
        return request - memory[GAIN] * weighted, {GAIN: memory[GAIN]}

    def effective_gain(self) -> float:
        return self.gain

    def secant_gain(self) -> float:
        return self.gain

    def largest_step(self) -> float:
        return float("inf")

    def with_effective_gain(self, gain: float) -> Self:
        return replace(self, gain=gain)


def near_fixed_point(controller: Controller) -> Controller:
    """Return the controller with its map as it is near the fixed point; itself where the map changes on line, or does not adapt."""
    deformation = controller.deformation
    if not deformation.adapts or not deformation.iteration.constant:
        return controller
    try:
        return controller.with_deformation(_linear(deformation))
    except FpirhcError:  # a controller whose map cannot be replaced
        return controller


def _linear(deformation: Deformation) -> Deformation:
    if deformation.inner is None:
        return LinearMap(deformation.effective_gain(), deformation.iteration.weights)
    return with_inner(deformation, _linear(deformation.inner))
