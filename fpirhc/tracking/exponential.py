"""Exponential decay of the tracking error, for any relative order.

With e = q^N - q and e_int its integral the law prescribes (d/dt + rate)^(n+1) e_int = 0, that is

    q^(n),Des = q^(n),N + sum_{s=0}^{n} C(n+1, s) rate^(n+1-s) e_int^(s),   e_int^(s) = e^(s-1) for s >= 1,

and without the integral (d/dt + rate)^n e = 0. The error is nominal minus actual, hence the plus signs.

References:
    J. K. Tar, J. F. Bito, I. Rudas, Acta Polytechnica Hungarica 13(1), 2016.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Self

import casadi as ca

from fpirhc.errors import InvalidValue
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, total
from fpirhc.symbolic.functions import power
from fpirhc.symbolic.layout import Expression
from fpirhc.tracking.base import Feedback, Tracking
from fpirhc.tracking.error import (
    Useful,
    bumpless,
    error_chains,
    gains_before,
    integral_delay,
    integral_update,
    law_signals,
)


@dataclass(frozen=True)
class Exponential(Tracking):
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
        return tuple(math.comb(degree, s) * power(self.rate, degree - s) for s in range(degree))

    @property
    def speed(self) -> float:
        """Lambda."""
        return self.rate

    def feedback(self, order: int) -> Feedback:
        """The gains for that order."""
        return Feedback(self.gains(order), self.integral, self.bumpless, self.rate)

    def within(self, largest: Sequence[float]) -> Self:
        """Return the law with these largest responses, unless the user has set them."""
        if self.largest:
            return self
        other = copy(self)  # not `replace`, which would check numbers that are live
        object.__setattr__(other, "largest", tuple(largest))
        return other

    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, warm_up, integral) -> (error to the target, desired, integral in use)."""
        del period
        reads, writes = law_signals(plant)
        orders = [plant.orders[k] for k in plant.controlled_indices]
        first_gains = [self.gains(order)[0] for order in orders] if self.integral else []

        def step(s: Signals) -> dict[str, Expression]:
            errors = error_chains(plant, s._target - s.state)
            first_integral = ca.vertcat(*(self._first_integral(chain) for chain in errors))
            integral_before, remembered = bumpless(s, first_gains)
            integral = ca.if_else(s.warm_up > 0.5, integral_before, first_integral)
            feedback = [self._feedback(integral[k], chain) for k, chain in enumerate(errors)]
            return {
                "_target_error": ca.vertcat(*(chain[0] for chain in errors)),
                "desired": s.nominal + ca.vertcat(*feedback),
                "_integral_used": integral,
                **remembered,
            }

        return Block("tracking", reads, writes, step, gains_before(plant, first_gains))

    def update(self, plant: Plant, period: float) -> Block:
        """Block that integrates the error, except while the command is clipped, and within its bounds."""
        return integral_update(plant, period, self._useful(plant))

    def delays(self, plant: Plant) -> tuple[Delay, ...]:
        """The delay of the integral of the error."""
        return integral_delay(plant)

    def _useful(self, plant: Plant) -> list[Useful]:
        """What the integrals may ask for; nothing where they are not fed back."""
        if not (self.integral and self.largest):
            return []
        gains = [self.gains(plant.orders[k])[:2] for k in plant.controlled_indices]
        return [Useful(integral, error, most) for (integral, error), most in zip(gains, self.largest, strict=True)]

    def _feedback(self, integral: Expression, chain: list[Expression]) -> Expression:
        terms = [integral, *chain] if self.integral else chain
        return total(g * e for g, e in zip(self.gains(len(chain)), terms, strict=True))

    def _first_integral(self, chain: list[Expression]) -> Expression:
        if not (self.integral and self.bumpless):
            return chain[0] * 0
        first, *others = self.gains(len(chain))
        return -total(g * e for g, e in zip(others, chain, strict=True)) / first


EXAMPLES = (Exponential(rate=6.0), Exponential(rate=6.0, bumpless=False), Exponential(rate=2.0, integral=False))
