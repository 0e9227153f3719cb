"""Decay of the tracking error with stated poles in z, for the cycles of a map.

With the shift z, the error e = y^N - y and its sum e_int the law prescribes

    (z - z_1) (z - z_2) ... (z - z_{n+1}) e_int = 0,

and without the sum (z - z_1) ... (z - z_n) e = 0. It is written in the divided differences delta = (z - 1) / T of the cycle T, as
every law on maps: (delta + (1 - z_1) / T) ... . A pole at zero is deadbeat: with an exact model the error is zero after n cycles
(one more with the sum). On differential equations, whose derivatives stand in place of delta, the poles are those of a cycle to
first order in 1 - z.

Reference: K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 3rd ed., Prentice Hall 1997, ch. 5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import Duration
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.functions import power
from fpirhc.tracking.base import Feedback
from fpirhc.tracking.linear_law import LinearLaw

_REAL = 1e-9  # share of an imaginary part that is rounding


@dataclass(frozen=True)
class ShiftPolynomial(LinearLaw):
    """The error modes have the stated poles in z.

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
    step: Duration = field(metadata={"structure": True})
    integral: bool = True
    bumpless: bool = True
    largest: Sequence[float] = field(default=(), metadata={"setting": "where given"})

    def __post_init__(self) -> None:
        every = [self.poles] if not isinstance(self.poles, Sequence) else list(self.poles)
        outside = [z for z in every if not abs(z) < 1]
        if outside or not every:
            wrong = f"{outside[0]:g} is not inside the unit circle" if outside else "there is none"
            raise InvalidValue(
                f"ShiftPolynomial(poles={self.poles!r}): {wrong}; 0 is deadbeat, and a slow mode is below 1"
            )
        coefficients = np.poly(every)
        if np.abs(np.imag(coefficients)).max() > _REAL:
            raise InvalidValue(
                f"ShiftPolynomial(poles={self.poles!r}): give a complex pole together with its conjugate"
            )

    def gains(self, order: int) -> tuple[float, ...]:
        """Gains of (e_int, e, delta e, ...) with the sum, of (e, delta e, ...) without; lowest difference first.

        Raises:
            InvalidValue: another number of poles than modes.
        """
        degree = order + 1 if self.integral else order
        if not isinstance(self.poles, Sequence):
            rate = (1 - self.poles) / self.step
            return tuple(math.comb(degree, s) * power(rate, degree - s) for s in range(degree))
        if len(self.poles) != degree:
            raise InvalidValue(
                f"ShiftPolynomial: {len(self.poles)} poles are given, and a quantity of relative order {order} has {degree} modes"
                f"{' with the sum of its errors' if self.integral else ''}; give {degree} poles, or one number for all"
            )
        coefficients = np.real(np.poly([(z - 1) / self.step for z in self.poles]))
        return tuple(float(c) for c in coefficients[:0:-1])

    def check_cycle(self, plant: Plant, period: float) -> None:
        """Raise if the poles are meant for another cycle.

        Raises:
            InvalidValue: with the cycle.
        """
        if abs(self.step - period) > _REAL * period:
            raise InvalidValue(
                f"ShiftPolynomial(step={self.step:g}): the control cycle is {period:g} {plant.time_unit}, and poles in z belong to "
                f"one cycle; write step={period:g}, with the poles of that cycle"
            )
        super().check_cycle(plant, period)

    @property
    def speed(self) -> float | None:
        """(1 - z) / T of the fastest mode."""
        every = [self.poles] if not isinstance(self.poles, Sequence) else list(self.poles)
        return max(abs(1 - z) for z in every) / self.step

    def feedback(self, order: int) -> Feedback:
        """The gains for that order."""
        rate = (1 - self.poles) / self.step if not isinstance(self.poles, Sequence) else None
        return Feedback(self.gains(order), self.integral, self.bumpless, rate)


EXAMPLES = (ShiftPolynomial(poles=0.98, step=5e-3), ShiftPolynomial(poles=0.99, step=5e-3, integral=False))
