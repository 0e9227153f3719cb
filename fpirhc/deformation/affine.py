"""The affine map: relaxed Picard iteration, without saturation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

from fpirhc.deformation.base import Deformation
from fpirhc.fields.kinds import NotZero
from fpirhc.symbolic.layout import Expression


@dataclass(frozen=True)
class Affine(Deformation):
    """r+ = r + (A_c / 2) (f - d), exactly linear.

    It is eq. (6) of Khan, Tar and Rudas with the kernel zeta(x) = x / 2 + D, whose fixed point x* = 2 D cancels D.

    Args:
        gain: A_c, negative where the model has the sign of the plant's input effect right.

    References:
        H. Khan, J. K. Tar, I. J. Rudas, Robot. Autom. Eng. J. 3(5), 2018, DOI 10.19080/RAEJ.2018.03.555623.
    """

    gain: NotZero

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + (A_c / 2) (f - d)."""
        del memory
        return request + 0.5 * self.gain * (response - desired), {}

    def effective_gain(self) -> float:
        """The effective gain a = -A_c / 2."""
        return -0.5 * self.gain

    def secant_gain(self) -> float:
        """The same as the effective gain, because the map is linear."""
        return self.effective_gain()

    def largest_step(self) -> float:
        return float("inf")

    def with_effective_gain(self, gain: float) -> Self:
        """Return the map with A_c = -2 a."""
        return replace(self, gain=-2.0 * gain)


EXAMPLES = (Affine(gain=-0.5),)
