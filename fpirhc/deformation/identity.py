"""No adaptation: the request is the desired response."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from fpirhc.deformation.base import Deformation, Iteration
from fpirhc.errors import NotSupported
from fpirhc.symbolic.layout import Expression


@dataclass(frozen=True)
class Identity(Deformation):
    """r+ = d: the request is the desired response, whatever the response of the plant.

    It is the only map that does not iterate: its gains are zero, and it corrects no response error.
    """

    @property
    def adapts(self) -> bool:
        return False

    @property
    def iteration(self) -> Iteration:
        return Iteration(slows_desired=False)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        del request, response, memory
        return desired, {}

    def effective_gain(self) -> float:
        return 0.0

    def secant_gain(self) -> float:
        return 0.0

    def largest_step(self) -> float:
        return float("inf")

    def with_effective_gain(self, gain: float) -> Self:
        """Raise, because there is no gain to change.

        Raises:
            NotSupported: always.
        """
        raise NotSupported(
            f"Identity() has no gain, so it cannot take {gain!r}; use Sigmoid(gain=...), the usual choice"
        )


EXAMPLES = (Identity(),)
