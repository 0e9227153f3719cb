"""The robust fixed point transformation, coordinate by coordinate, and along the direction of the response error.

Source: J. K. Tar, J. F. Bitó, L. Nádai, J. A. Tenreiro Machado, Robust fixed point transformations in adaptive control using local
basin of attraction, Acta Polytechnica Hungarica 6(1), 2009.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from fpirhc.deformation.base import Deformation, smooth_norm
from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import NotZero
from fpirhc.symbolic.layout import Expression

_FLOOR = 1e-9  # A_c |h| below which the norm is rounded off, so that its derivatives exist at zero


@dataclass(frozen=True)
class _Transformation(Deformation):
    """What both have: the settings K_c, B_c and A_c, and the gains."""

    offset: NotZero
    sign: float
    gain: NotZero

    def __post_init__(self) -> None:
        if self.sign not in (-1, 1):
            raise InvalidValue(
                f"{type(self).__name__}(sign={self.sign!r}): expected -1 or 1; -1 for offset > 0 and a model of right sign"
            )

    def effective_gain(self) -> float:
        """The effective gain a = -K_c B_c A_c."""
        return -self.offset * self.sign * self.gain

    def with_effective_gain(self, gain: float) -> Self:
        """Return the map with A_c = -a / (K_c B_c)."""
        return replace(self, gain=-gain / (self.offset * self.sign))


@dataclass(frozen=True)
class RFPT(_Transformation):
    """r+ = (K_c + r) [1 + B_c tanh(A_c (f - d))] - K_c, for each coordinate by itself.

    The gains hold for |K_c| >> |r|; at a request r they are larger by the factor 1 + r / K_c. A second, false fixed
    point r = -K_c repels the iteration when B_c tanh(A_c (f(-K_c) - d)) > 0. One step is at most |K_c + r|, and the effective
    gain is a = -K_c B_c A_c.

    Args:
        offset: K_c, 10 to 100 times the largest |request|, in units of the response.
        sign: B_c, -1 or 1; the opposite of the sign of K_c df/dr.
        gain: A_c, in reciprocal units of the response; a / |K_c| with a = 0.2 ... 0.6 / max df/dr.

    Raises:
        InvalidValue: offset or gain zero or not finite, or a sign other than -1 and 1.
    """

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + (K_c + r) B_c tanh(A_c (f - d)), the same without the digits that adding and subtracting K_c would cost."""
        del memory
        saturated = self.sign * ca.tanh(self.gain * (response - desired))
        return request + (self.offset + request) * saturated, {}


@dataclass(frozen=True)
class RFPTVector(_Transformation):
    """r+ = (1 + B) r + B K_c h / |h|, with B = B_c tanh(A_c |h|) and h = f - d.

    The gains hold for |K_c| >> |r|. One step is at most |r| + |K_c|.

    Args:
        offset: K_c, 10 to 100 times the largest |request|, in units of the response.
        sign: B_c, -1 or 1; the opposite of the sign of K_c times the eigenvalues of df/dr.
        gain: A_c, in reciprocal units of the response; a / |K_c| with a = 0.2 ... 0.6 / max eigenvalue of df/dr.

    Raises:
        InvalidValue: offset or gain zero or not finite, or a sign other than -1 and 1.
    """

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + B_c [tanh(A_c s) / s] (n r + K_c h); s is |h| rounded off above zero, n is |h| and zero at h = 0."""
        del memory
        error, floor = response - desired, _FLOOR / abs(self.gain)
        size = smooth_norm(error, floor)
        vanishing = ca.sumsqr(error) / (size + floor)
        slope = self.sign * ca.tanh(self.gain * size) / size
        return request + slope * (vanishing * request + self.offset * error), {}


EXAMPLES = (
    RFPT(offset=1e5, sign=-1, gain=5e-6),
    RFPT(offset=-1e4, sign=1, gain=4e-5),
    RFPTVector(offset=1e5, sign=-1, gain=5e-6),
)
