"""How much of a lag, or of a resonance, between request and response a loop bears that its model lacks (docs/theory-robust.md)."""

from __future__ import annotations

import math

from fpirhc.errors import InvalidValue

_BISECTIONS = 60


def damped_product(period: float, lag: float, rate: float, poles: int, *, damping: float) -> float:
    """Return the largest a lambda whose fast pair keeps that damping behind an unknown lag; 0 where none does.

    It is (T / tau) ((1 - N Lambda tau) / (2 zeta))^2 for the increment and the model-referenced form, and infinite without a lag.

    Args:
        period: T of the control cycle, s.
        lag: tau, s.
        rate: Lambda of the tracking law, 1/s.
        poles: N of the tracking law.
        damping: zeta, dimensionless.

    Raises:
        InvalidValue: a period or a damping that is not positive, a negative lag or rate, fewer than one pole.
    """
    _check(period, lag, poles)
    if not (damping > 0 and rate >= 0):
        raise InvalidValue(
            f"damped_product(rate={rate!r}, damping={damping!r}): expected a rate of at least 0, 1/s, and a positive damping"
        )
    if not lag:
        return math.inf
    spare = max(1 - poles * rate * lag, 0.0)
    return period / lag * (spare / (2 * damping)) ** 2


def bearable_lag(product: float, period: float, rate: float, poles: int, *, damping: float) -> float:
    """Return the longest unknown lag, s, with which the fast pair keeps that damping: `damped_product` solved for tau.

    Args:
        product: a lambda, dimensionless.
        period: T of the control cycle, s.
        rate: Lambda of the tracking law, 1/s.
        poles: N of the tracking law.
        damping: zeta, dimensionless.

    Raises:
        InvalidValue: a product, period or damping that is not positive, a negative rate, fewer than one pole.
    """
    if not 0 < product < math.inf:
        raise InvalidValue(f"bearable_lag(product={product!r}): expected a positive product of gain and eigenvalue")
    low, high = 0.0, period / product / (2 * damping) ** 2 if damping > 0 else 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        fits = damped_product(period, middle, rate, poles, damping=damping) >= product
        low, high = (middle, high) if fits else (low, middle)
    return low


def _check(period: float, lag: float, poles: int = 1) -> None:
    if not (0 < period < math.inf and 0 <= lag < math.inf and poles >= 1):
        raise InvalidValue(
            f"period={period!r}, lag={lag!r}, poles={poles!r}: expected a positive period and a lag of at least 0, s, and at least "
            "one pole of the tracking law"
        )


def resonant_limit(
    period: float, rate: float, poles: int, *, frequency: float, damping: float, eigenvalue: float = 1.0
) -> float:
    """Return the largest effective gain behind the resonance, T (2 zeta w0 / lambda - N Lambda); 0 or less where none is stable.

    The value is accurate to 10 % where w0 > 20 Lambda and the margin is large. A negative value means that the tracking law alone
    excites the resonance.

    Args:
        period: T of the control cycle, s.
        rate: Lambda of the tracking law, 1/s; 0 for the iteration alone.
        poles: N of the tracking law.
        frequency: w0 of the resonance, rad/s.
        damping: zeta of the resonance, dimensionless.
        eigenvalue: lambda of the response Jacobian.

    Raises:
        InvalidValue: a period, frequency or eigenvalue that is not positive, a negative rate or damping, fewer than one pole.
    """
    positive = all(0 < v < math.inf for v in (period, frequency, eigenvalue))
    if not (positive and rate >= 0 and damping >= 0 and poles >= 1):
        raise InvalidValue(
            f"resonant_limit(period={period!r}, rate={rate!r}, poles={poles!r}, frequency={frequency!r}, damping={damping!r}, "
            f"eigenvalue={eigenvalue!r}): expected a positive period, frequency and eigenvalue, a rate and a damping of at "
            "least 0, and at least one pole"
        )
    return period * (2 * damping * frequency / eigenvalue - poles * rate)
