"""Bounds of believed states, kept from inside: by a logarithm of the distance, and by steps that leave a tenth of it.

To second order the cost -mu log s of a distance s is a measurement of this distance that says 2 s, with the deviation
s / sqrt(mu).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca

from fpirhc.symbolic.layout import Expression

_STAYS = 0.1  # share of its distance from a bound that a step leaves at least


@dataclass(frozen=True, eq=False)
class Interior:
    """The states inside some bounds.

    Args:
        elements: names of the states.
        bounds: state -> (lower, upper); an end may be infinite.
        barrier: weight mu of the logarithm.
    """

    elements: tuple[str, ...]
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    barrier: float = 1.0

    @property
    def ends(self) -> list[tuple[int, float, float]]:
        """Place, value and direction (1: lower, -1: upper) of every finite end."""
        both = [
            (self.elements.index(n), e, d) for n, b in self.bounds.items() for e, d in zip(b, (1.0, -1.0), strict=True)
        ]
        return [one for one in both if math.isfinite(one[1])]

    def measured(self, x: ca.SX) -> tuple[ca.SX, ca.SX, list[ca.SX]]:
        """Return errors, slopes and variances of the measurements for which the logarithms stand."""
        distances, slopes = ca.SX(0, 1), ca.SX(0, x.numel())
        for place, end, direction in self.ends:
            slope = ca.SX.zeros(1, x.numel())
            slope[place] = direction
            distances, slopes = ca.vertcat(distances, direction * (x[place] - end)), ca.vertcat(slopes, slope)
        return distances, slopes, [d**2 / self.barrier for d in ca.vertsplit(distances)] if self.ends else []

    def bounded(self, before: Expression, after: Expression) -> Expression:
        """Return a state that has at least a tenth of the distance from every bound that another state has."""
        entries = ca.vertsplit(after)
        for place, end, direction in self.ends:
            nearest = end + _STAYS * (before[place] - end)
            entries[place] = (ca.fmax if direction > 0 else ca.fmin)(entries[place], nearest)
        return ca.vertcat(*entries)
