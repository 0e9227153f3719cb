"""The common part of laws that feed errors back with constant gains, with or without the integral of the error."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING, Self

import casadi as ca

from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, total
from fpirhc.symbolic.layout import Expression
from fpirhc.tracking.base import Tracking
from fpirhc.tracking.error import (
    Useful,
    bumpless,
    check_modes,
    error_chains,
    gains_before,
    integral_delay,
    integral_update,
    law_signals,
    own_errors,
)


class LinearLaw(Tracking):
    """q^(n),Des = q^(n),N + gains times (e_int, e, e', ...), the gains those of the members."""

    if TYPE_CHECKING:

        @property
        def integral(self) -> bool:
            """Whether the integral of the error is fed back."""

        @property
        def bumpless(self) -> bool:
            """Whether the integral starts so that the first desired response is the nominal one."""

        @property
        def largest(self) -> Sequence[float]:
            """Responses beyond ten times of which an error is not integrated; empty: not decided yet."""

    else:  # plain attributes, so that dataclasses may have fields of these names
        integral: bool
        bumpless: bool
        largest: Sequence[float]

    @abstractmethod
    def gains(self, order: int) -> tuple[float, ...]:
        """Gains of (e_int, e, e', ...) with the integral, of (e, e', ...) without; lowest derivative first."""

    def check_cycle(self, plant: Plant, period: float) -> None:
        """Raise if the law cannot act on the plant in this cycle; by default, if its modes do not decay in the steps of a map.

        Raises:
            InvalidValue: a mode that does not decay, with its pole.
        """
        del period
        for order in plant.response_orders.values():
            check_modes(self, plant, self.gains(order))

    def within(self, largest: Sequence[float]) -> Self:
        """Return the law with these largest responses, unless the user has set them."""
        if self.largest:
            return self
        other = copy(self)  # not `replace`, which would check numbers that are live
        object.__setattr__(other, "largest", tuple(largest))
        return other

    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, warm_up, integral) -> (error to the target, desired, integral in use)."""
        self.check_cycle(plant, period)
        reads, writes = law_signals(plant)
        orders = plant.response_orders.values()
        first_gains = [self.gains(order)[0] for order in orders] if self.integral else []

        def step(s: Signals) -> dict[str, Expression]:
            error = s._target - s.state
            errors, own = error_chains(plant, error), own_errors(plant, error)
            first_integral = ca.vertcat(*map(self._first_integral, own, errors))
            integral_before, remembered = bumpless(s, first_gains)
            integral = ca.if_else(s.warm_up > 0.5, integral_before, first_integral)
            feedback = [self._feedback(integral[k], chain) for k, chain in enumerate(errors)]
            return {
                "_target_error": ca.vertcat(*own),
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
        gains = [(*self.gains(order), 1.0)[:2] for order in plant.response_orders.values()]
        return [Useful(integral, error, most) for (integral, error), most in zip(gains, self.largest, strict=True)]

    def _feedback(self, integral: Expression, chain: list[Expression]) -> Expression:
        terms = [integral, *chain] if self.integral else chain
        return total(g * e for g, e in zip(self.gains(len(chain)), terms, strict=True))

    def _first_integral(self, error: Expression, chain: list[Expression]) -> Expression:
        if not (self.integral and self.bumpless):
            return error * 0
        first, *others = self.gains(len(chain))
        return -total(g * e for g, e in zip(others, chain, strict=True)) / first
