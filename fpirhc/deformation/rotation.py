"""The abstract-rotation fixed point transformation. Theory: docs/theory.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.fields.kinds import NotZero, Positive
from fpirhc.symbolic.layout import Expression

_FLOOR = 1e-18  # added to the squared chord between the unit vectors, so that its root has derivatives at zero
_ROOM = 4.0  # R^2 is at least this many times the largest squared vector, so the angle stays within 60 degrees
_SECANT = 2 * math.pi / (3 * math.sqrt(3))  # longest arc per unit of response error for vectors up to R / 2


@dataclass(frozen=True)
class Rotation(Deformation):
    """r+ = r turned by a fraction of the angle that turns f into d, in the space with one dummy component.

    r+ = r - fraction (f - d) up to terms of third order in |vectors| / R. Where a vector is longer than radius / 2, R
    grows to twice its length, so the map is defined everywhere and its steps are bounded by the secant gain.

    Args:
        fraction: share of the angle, dimensionless; positive where the model has the sign of the input effect right, and
            usually at most 1.
        radius: R, the common norm; several times the largest request, response and desired response, in their units.

    References:
        B. Csanádi, P. Galambos, J. K. Tar, Gy. Györök, A. Serester, A novel, abstract rotation-based fixed point
        transformation in adaptive control, IEEE SMC 2018. The map here is in its spirit.
    """

    fraction: NotZero
    radius: Positive

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the first components of O (r, sqrt(R^2 - |r|^2))."""
        del memory
        squares = [ca.sumsqr(v) for v in (request, response, desired)]
        longest = ca.fmax(ca.fmax(squares[0], squares[1]), squares[2])
        radius2 = ca.fmax(self.radius * self.radius, _ROOM * longest)
        heights = [ca.sqrt(radius2 - square) for square in squares]
        radius = ca.sqrt(radius2)
        unit = (response / radius, heights[1] / radius)
        error = response - desired
        # The difference of the two heights in a form that keeps its digits near zero error.
        drop = -ca.dot(error, response + desired) / (heights[1] + heights[2])
        chord = (error / radius, drop / radius)
        first = _turned(unit, chord, (request, heights[0]))
        second = _turned(unit, chord, first)
        along, across = self._coefficients(ca.sumsqr(chord[0]) + chord[1] ** 2)
        return request + along * first[0] + across * second[0], {}

    def effective_gain(self) -> float:
        return self.fraction

    def secant_gain(self) -> float:
        return _SECANT * self.fraction

    def with_effective_gain(self, gain: float) -> Self:
        return replace(self, fraction=gain)

    def _coefficients(self, chord2: Expression) -> tuple[Expression, Expression]:
        """sin(theta) / sin(phi) and (1 - cos(theta)) / sin(phi)^2 from the squared chord (2 sin(phi / 2))^2."""
        rounded = chord2 + _FLOOR
        half_angle = ca.asin(0.5 * ca.sqrt(rounded))
        half_turn = self.fraction * half_angle
        sine2, half_sine = rounded * (1 - 0.25 * rounded), ca.sin(half_turn)
        return 2 * half_sine * ca.cos(half_turn) / ca.sqrt(sine2), 2 * half_sine**2 / sine2


def _turned(
    unit: tuple[Expression, Expression], chord: tuple[Expression, Expression], vector: tuple[Expression, Expression]
) -> tuple[Expression, Expression]:
    """B v = a (c'v) - c (a'v) with c = a - b, each vector as (column, dummy component)."""
    along_unit = ca.dot(unit[0], vector[0]) + unit[1] * vector[1]
    along_chord = ca.dot(chord[0], vector[0]) + chord[1] * vector[1]
    return unit[0] * along_chord - chord[0] * along_unit, unit[1] * along_chord - chord[1] * along_unit


EXAMPLES = (Rotation(fraction=0.4, radius=1e3), Rotation(fraction=0.4, radius=1.0))
