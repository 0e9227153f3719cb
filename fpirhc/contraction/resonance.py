"""The largest gain behind a resonance (a flexible joint) that the model lacks.

With f = lambda r w0^2 / (s^2 + 2 zeta w0 s + w0^2) the increment and model-referenced forms and a tracking law with N poles at
-Lambda give, near s = i w0, where the resonance alone has s^2 + 2 zeta w0 s + w0^2 = 0,

    s^2 + 2 zeta w0 s + w0^2 + lambda w0^2 (N Lambda + w) / s + ... = 0,      1 / s = -s / w0^2,

so the pair keeps the damping 2 zeta w0 - lambda (N Lambda + w) to leading order in (N Lambda + w) / w0. It is stable while

    lambda (N Lambda + a / T) < 2 zeta w0.
"""

from __future__ import annotations

import math

from fpirhc.errors import InvalidValue


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
