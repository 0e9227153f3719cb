"""The sigmoid-generated fixed point transformation: saturating, along the direction of the response error.

With zeta(x) = atanh(tanh(x + D) / 2) and its fixed point x*, the addition theorems of tanh and atanh give the step
without cancellation and without a special case at zero,

    zeta(w + x*) - x* = atanh( zeta'(x*) tanh(w) / (1 + q tanh(w)) ),    q = 3 y / (2 (1 - y^2)),  y = tanh(x*).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Self

import casadi as ca

from fpirhc.deformation.base import Deformation, smooth_norm
from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import NotZero, Positive, Range
from fpirhc.symbolic.layout import Expression

# Beyond it zeta'(x*) is below 2e-4: the map hardly moves and loses digits.
_SHIFTS = Range("a number from -5 to 5, such as 0.3", lambda v: -5 <= v <= 5)
_FLOOR = 1e-9  # |h| / S below which the norm is rounded off, so that its derivatives exist at zero
_BISECTIONS = 60


@dataclass(frozen=True)
class Sigmoid(Deformation):
    """r+ = r + S [zeta(A_c |h| / S + x*) - x*] h / |h|, with zeta(x) = atanh(tanh(x + D) / 2) and h = f - d.

    Small errors shrink exponentially, large ones by at most `largest_step()` per cycle, so S must cover the largest
    change of the desired response in one cycle; apart from that S does not matter.

    Args:
        gain: A_c, dimensionless; negative, because the correction acts against the error (the model has the right sign of the
            input's effect). With the shift of 0.3 the effective gain is -0.397 A_c.
        shift: D, dimensionless, |D| <= 5. Give it the sign opposite to A_c, or the largest step shrinks (for |D| = 0.3
            from 0.81 S to 0.29 S).
        scale: S, in units of the response; None leaves the choice to the controller.

    References:
        A. Dineva, J. K. Tar, A. Várkonyi-Kóczy, V. Piuri, Generalization of a sigmoid generated fixed point
        transformation from SISO to MIMO systems, IEEE INES 2015.
        H. Khan, J. K. Tar, I. J. Rudas, Robot. Autom. Eng. J. 3(5), 2018, eq. (6), with x* subtracted and added to
        the last request as in the former.
    """

    gain: NotZero
    shift: Annotated[float, _SHIFTS] = 0.3
    scale: Positive | None = field(default=None, metadata={"automatic": True})

    @cached_property
    def _tanh_fixed_point(self) -> float:
        """The root y = tanh(x*) of 2 t y^2 + y = t with t = tanh(D), in the form that has no 0/0 at D = 0."""
        t = ca.tanh(self.shift)
        return 2 * t / (1 + ca.sqrt(1 + 8 * (t * t)))

    @property
    def fixed_point(self) -> float:
        """x* = zeta(x*)."""
        return ca.atanh(self._tanh_fixed_point)

    @property
    def slope(self) -> float:
        """zeta'(x*), between 0 and 1/2."""
        y = self._tanh_fixed_point
        return (1 - 4 * (y * y)) / (2 * (1 - y * y))

    @cached_property
    def steepest_secant(self) -> float:
        """Largest [zeta(w + x*) - x*] / w over the w that the sign of A_c allows.

        Towards the inflection of zeta the secant is steepest where it is a tangent, between one and two times the
        distance to the inflection; away from it, at w = 0.
        """
        if self.shift * self.gain >= 0:
            return self.slope
        mirrored = replace(self, gain=-abs(self.gain), shift=abs(self.shift))
        near, far = (mirrored.fixed_point + mirrored.shift, 2 * (mirrored.fixed_point + mirrored.shift))
        for _ in range(_BISECTIONS):
            middle = 0.5 * (near + far)
            x = mirrored.fixed_point - middle
            beyond = mirrored._slope_at(x) * middle < mirrored.fixed_point - mirrored._kernel(x)
            near, far = (near, middle) if beyond else (middle, far)
        return (mirrored.fixed_point - mirrored._kernel(mirrored.fixed_point - near)) / near

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + S [zeta(A_c |h| / S + x*) - x*] h / |h|.

        Raises:
            InvalidValue: the scale is still to be chosen.
        """
        del memory
        scale, error = self._chosen_scale(), response - desired
        size = smooth_norm(error, _FLOOR * scale)
        saturated = ca.tanh((self.gain / scale) * size)
        y = self._tanh_fixed_point
        growth = ca.atanh(self.slope * saturated / (1 + 1.5 * y / (1 - y * y) * saturated))
        return request + (scale * growth / size) * error, {}

    def effective_gain(self) -> float:
        """The effective gain a = -A_c zeta'(x*)."""
        return -self.gain * self.slope

    def secant_gain(self) -> float:
        return -self.gain * self.steepest_secant

    def largest_step(self) -> float:
        """The largest step: S (atanh(1/2) + x*) for A_c < 0 and S (atanh(1/2) - x*) for A_c > 0, with D > 0.

        Raises:
            InvalidValue: the scale is still to be chosen.
        """
        return self._chosen_scale() * (math.atanh(0.5) - ca.copysign(self.fixed_point, self.shift * self.gain))

    def with_effective_gain(self, gain: float) -> Self:
        """Return the map with A_c = -a / zeta'(x*)."""
        return replace(self, gain=-gain / self.slope)

    def _kernel(self, x: float) -> float:
        return math.atanh(0.5 * math.tanh(x + self.shift))

    def _slope_at(self, x: float) -> float:
        t = math.tanh(x + self.shift)
        return 0.5 * (1 - t**2) / (1 - 0.25 * t**2)

    def _chosen_scale(self) -> float:
        if self.scale is None:
            raise InvalidValue(
                "Sigmoid(scale=None): the scale is still to be chosen; give Sigmoid(scale=S), with S above the largest change of "
                "the desired response in one cycle"
            )
        return self.scale


EXAMPLES = (
    Sigmoid(gain=-0.5, scale=1.0),
    Sigmoid(gain=-1.5, shift=0.0, scale=20.0),
    Sigmoid(gain=0.5, shift=-0.3, scale=1.0),
    Sigmoid(gain=0.5, shift=0.3, scale=1.0),
)
