"""A map as it is near its fixed point, r+ = r - a (f - d), with the gain a in its memory.

The loop for every gain is then one loop with other memories, affine in a.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from fpirhc.deformation.base import Deformation, Iteration, with_inner
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

GAIN, POLE, FILTERED, NOISE = "map_gain", "map_pole", "map_filtered", "map_noise"  # in the memory


@dataclass(frozen=True)
class LinearMap(Deformation):
    """r+ = r - a W (f - d); behind noise and a filter r+ = r - a W g+ with g+ = p g + (1 - p)(f + n - d)."""

    gain: float  # a at the start
    weights: tuple[tuple[float, ...], ...] | None = None  # W by rows; None: the one matrix
    noisy: bool = False  # whether n and p are in the memory: n is zero again one cycle later, p is zero at the start

    @property
    def iteration(self) -> Iteration:
        """Of no limit, because a gain that a run refuses has poles too."""
        return Iteration(limited=False, weights=self.weights)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        more = (scalar(POLE), Signal(FILTERED, elements), Signal(NOISE, elements)) if self.noisy else ()
        return Layout((scalar(GAIN, start=self.gain), *more))

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        error, more = response - desired, dict[str, Expression]()
        if self.noisy:
            pole = memory[POLE]
            error = pole * memory[FILTERED] + (1 - pole) * (error + memory[NOISE])
            more = {POLE: pole, FILTERED: error, NOISE: 0 * memory[NOISE]}
        weighted = error if self.weights is None else ca.DM(self.weights) @ error
        return request - memory[GAIN] * weighted, {GAIN: memory[GAIN], **more}

    def effective_gain(self) -> float:
        return self.gain

    def secant_gain(self) -> float:
        return self.gain

    def largest_step(self) -> float:
        return float("inf")

    def with_effective_gain(self, gain: float) -> Self:
        return replace(self, gain=gain)


def linear(deformation: Deformation, *, noisy: bool = False) -> Deformation:
    """Return the deformation with its map as a `LinearMap`."""
    if deformation.inner is None:
        return LinearMap(deformation.effective_gain(), deformation.iteration.weights, noisy)
    return with_inner(deformation, linear(deformation.inner, noisy=noisy))


def places_of(name: str, loop: Composite) -> list[int]:
    """Return the places in a loop's memory of what a `LinearMap` keeps under a name."""
    return [k for k, column in enumerate(loop.memory.columns) if name in column.split(".")]
