"""Exponential decay of the tracking error, for any relative order.

With e = q^N - q and e_int its integral the law prescribes (d/dt + rate)^(n+1) e_int = 0, that is

    q^(n),Des = q^(n),N + sum_{s=0}^{n} C(n+1, s) rate^(n+1-s) e_int^(s),   e_int^(s) = e^(s-1) for s >= 1,

and without the integral (d/dt + rate)^n e = 0. The error is nominal minus actual, hence the plus signs. On a map with cycles of T
the law is exact with divided differences for derivatives: all modes have the pole z = 1 - rate T, and rate = 1 / T is deadbeat.

References:
    J. K. Tar, J. F. Bito, I. Rudas, Acta Polytechnica Hungarica 13(1), 2016.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from fpirhc.errors import InvalidValue
from fpirhc.symbolic.functions import power
from fpirhc.tracking.base import Feedback
from fpirhc.tracking.linear_law import LinearLaw


@dataclass(frozen=True)
class Exponential(LinearLaw):
    """All error modes decay as exp(-rate t).

    Args:
        rate: Lambda, 1/s. The digital loop needs rate x period well below 0.667 for n = 2 (0.412 for n = 4).
        integral: whether the integral of the error is fed back (it removes constant offsets and adds an undershoot).
        bumpless: whether the integral starts so that the first desired response is the nominal one.
        largest: response of every controlled coordinate beyond ten times of which an error is not integrated, and an integral does
            not grow or start a run; infinite for no bound. Empty: what the limits of the inputs allow.

    Raises:
        InvalidValue: a rate that is not positive.
    """

    rate: float
    integral: bool = True
    bumpless: bool = True
    largest: Sequence[float] = field(default=(), metadata={"setting": "where given"})

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate > 0):
            raise InvalidValue(f"tracking rate must be positive (1/s), got {self.rate}")

    def gains(self, order: int) -> tuple[float, ...]:
        """Gains of (e_int, e, e', ...) with the integral, of (e, e', ...) without; lowest derivative first."""
        degree = order + 1 if self.integral else order
        return tuple([math.comb(degree, s) * power(self.rate, degree - s) for s in range(degree)])

    @property
    def speed(self) -> float:
        """Lambda."""
        return self.rate

    def feedback(self, order: int) -> Feedback:
        """The gains for that order."""
        return Feedback(self.gains(order), self.integral, self.bumpless, self.rate)


EXAMPLES = (Exponential(rate=6.0), Exponential(rate=6.0, bumpless=False), Exponential(rate=2.0, integral=False))
