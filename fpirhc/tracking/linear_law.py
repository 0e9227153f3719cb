"""Laws that feed errors back with constant gains, with or without the integral of the error.

The error is nominal minus actual, hence the plus signs. On maps divided differences delta = (z - 1) / T of the cycle T stand in
place of derivatives, and the integral is a sum.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import Duration, Positive
from fpirhc.plant.maps import check_modes
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, total
from fpirhc.symbolic.layout import Expression
from fpirhc.tracking.base import IntegralLaw, Useful, decay_gains, error_chains, law_signals, own_errors

_SAME = 1e-9  # share of a cycle that is rounding


class LinearLaw(IntegralLaw):
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

    def gains_of(self, plant: Plant) -> list[tuple[float, ...]]:
        """Gains of every controlled coordinate; by default those of its order."""
        of = {order: self.gains(order) for order in {*plant.response_orders.values()}}
        return [of[order] for order in plant.response_orders.values()]

    def check(self, plant: Plant, period: float) -> None:  # noqa: ARG002
        """Raise if modes do not decay in the steps of a map."""
        for gains in self.gains_of(plant):
            check_modes(self, plant, gains)

    def law(self, plant: Plant, period: float) -> Block:  # noqa: ARG002
        """Block (state, target, nominal, warm_up, integral) -> (error to the target, desired, integral in use)."""
        reads, writes = law_signals(plant)
        gains = self.gains_of(plant)

        def step(s: Signals) -> dict[str, Expression]:
            error = s._target - getattr(s, plant.output.name)
            errors, own = error_chains(plant, error), own_errors(plant, error)
            first_integral = ca.vertcat(*map(self._first_integral, gains, own, errors))
            integral = ca.if_else(s.warm_up > 0.5, s._integral_before, first_integral)
            terms = [[*([integral[k]] if self.integral else []), *chain] for k, chain in enumerate(errors)]
            feedback = [total(g * e for g, e in zip(*own, strict=True)) for own in zip(gains, terms, strict=True)]
            return {
                "_target_error": ca.vertcat(*own),
                "desired": s.nominal + ca.vertcat(*feedback),
                "_integral_used": integral,
            }

        return Block("tracking", reads, writes, step)

    def _useful(self, plant: Plant) -> list[Useful]:
        if not (self.integral and self.largest):
            return []
        gains = [(*own, 1.0)[:2] for own in self.gains_of(plant)]
        return [Useful(integral, error, most) for (integral, error), most in zip(gains, self.largest, strict=True)]

    def _first_integral(self, gains: Sequence[float], error: Expression, chain: list[Expression]) -> Expression:
        if not (self.integral and self.bumpless):
            return error * 0
        first, *others = gains
        return -total(g * e for g, e in zip(others, chain, strict=True)) / first


@dataclass(frozen=True)
class Exponential(LinearLaw):
    """All error modes decay as exp(-rate t): (d/dt + rate)^(n+1) e_int = 0, and without the integral (d/dt + rate)^n e = 0.

        q^(n),Des = q^(n),N + sum_{s=0}^{n} C(n+1, s) rate^(n+1-s) e_int^(s),   e_int^(s) = e^(s-1) for s >= 1

    On a map with cycles of T all modes have the pole z = 1 - rate T, and rate = 1 / T is deadbeat. Source: J. K. Tar, J. F. Bito,
    I. Rudas, Acta Polytechnica Hungarica 13(1), 2016.

    Args:
        rate: Lambda, 1/s. The digital loop needs rate x period well below 0.667 for n = 2 (0.412 for n = 4).
        integral: whether the integral of the error is fed back (it removes constant offsets and adds an undershoot).
        bumpless: whether the integral starts so that the first desired response is the nominal one.
        largest: response of every controlled coordinate beyond ten times of which an error is not integrated, and an integral does
            not grow or start a run; infinite for no bound. Empty: what the limits of the inputs allow.
    """

    rate: Positive
    integral: bool = True
    bumpless: bool = True
    largest: Sequence[float] = ()

    def gains(self, order: int) -> tuple[float, ...]:
        return decay_gains(self.rate, order + 1 if self.integral else order)


@dataclass(frozen=True)
class ShiftPolynomial(LinearLaw):
    """The error modes have the stated poles in z.

        (z - z_1) ... (z - z_{n+1}) e_int = 0,      without the sum  (z - z_1) ... (z - z_n) e = 0

    It is written in divided differences, (delta + (1 - z_1) / T) ... . A pole at zero is deadbeat: with an exact model the error is
    zero after n cycles (one more with the sum). On differential equations the poles are those of a cycle to first order in 1 - z.
    Source: K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 3rd ed., 1997, ch. 5.

    Args:
        poles: one real number for all modes, or one number per mode, complex ones with their conjugates; inside the unit circle.
        step: the control cycle T, for which they are meant.
        integral: whether the sum of the errors is fed back (it removes constant offsets, and has one more pole).
        bumpless: whether the sum starts so that the first desired response is the nominal one.
        largest: see `Exponential`.

    Raises:
        InvalidValue: a pole that is not inside the unit circle, or complex without its conjugate; when the loop is built, another
            number of poles than modes, or another cycle.
    """

    poles: float | Sequence[float | complex]
    step: Duration
    integral: bool = True
    bumpless: bool = True
    largest: Sequence[float] = ()

    def __post_init__(self) -> None:
        every = [self.poles] if not isinstance(self.poles, Sequence) else list(self.poles)
        outside = [z for z in every if not abs(z) < 1]
        if outside or not every:
            wrong = f"{outside[0]:g} is not inside the unit circle" if outside else "there is none"
            raise InvalidValue(f"ShiftPolynomial(poles={self.poles!r}): {wrong}; 0 is deadbeat, a slow mode below 1")
        if np.iscomplexobj(np.poly(every)):
            raise InvalidValue(f"ShiftPolynomial(poles={self.poles!r}): give a complex pole with its conjugate")

    def gains(self, order: int) -> tuple[float, ...]:
        """Gains of (e_int, e, delta e, ...) with the sum, of (e, delta e, ...) without; lowest difference first.

        Raises:
            InvalidValue: another number of poles than modes.
        """
        degree = order + 1 if self.integral else order
        if not isinstance(self.poles, Sequence):
            return decay_gains((1 - self.poles) / self.step, degree)
        if len(self.poles) != degree:
            raise InvalidValue(
                f"ShiftPolynomial: {len(self.poles)} poles are given, and a quantity of relative order {order} has {degree} modes"
                f"{' with the sum of its errors' if self.integral else ''}; give {degree} poles, or one number for all"
            )
        coefficients = np.real(np.poly([(z - 1) / self.step for z in self.poles]))
        return tuple(float(c) for c in coefficients[:0:-1])

    def check(self, plant: Plant, period: float) -> None:
        """Raise if the poles are meant for another cycle.

        Raises:
            InvalidValue: with the cycle.
        """
        if abs(self.step - period) > _SAME * period:
            raise InvalidValue(
                f"ShiftPolynomial(step={self.step:g}): the control cycle is {period:g} {plant.time_unit}, and poles in z belong to "
                f"one cycle; write step={period:g}, with the poles of that cycle"
            )
        super().check(plant, period)


EXAMPLES = (
    Exponential(rate=6.0),
    Exponential(rate=6.0, bumpless=False),
    Exponential(rate=2.0, integral=False),
    ShiftPolynomial(poles=0.98, step=5e-3),
    ShiftPolynomial(poles=0.99, step=5e-3, integral=False),
)
