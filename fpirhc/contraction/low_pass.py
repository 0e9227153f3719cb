"""The plain form passes the desired response through a low-pass: how fast the iteration must be for its tracking law.

The plain form moves the whole request, r' = -w (f - d) with w = a / T, so on f = lambda r it passes d through w
lambda / (s + w lambda). A tracking law with N poles at -Lambda around a chain of integrators then has the
characteristic polynomial

    s^(N+1) + w lambda (s + Lambda)^N.

On the imaginary axis the argument is (N + 1) pi / 2 = pi + N atan(omega / Lambda), so it crosses at omega = Lambda tan(theta),
theta = (N - 1) pi / (2 N), and there |s|^(N+1) = w lambda |s + Lambda|^N gives

    w lambda / Lambda = sin(theta)^N tan(theta):    0, 1/2, 9/8, 1.759, 2.395    for N = 1, 2, 3, 4, 5.

For a small w the N + 1 roots near zero lie on a circle and some are in the right half-plane, so the loop is stable
above this value alone. The increment form passes d at once, its polynomial is (s + w)(s + Lambda)^N for lambda = 1,
and any w > 0 is stable.
"""

from __future__ import annotations

import math

from fpirhc.errors import InvalidValue


def slowest_iteration(poles: int) -> float:
    """Return the least a lambda / (T Lambda) with which the plain form is stable; 0 for one pole.

    Args:
        poles: N of the tracking law: n + 1 for relative order n with the integral, n without it.

    Raises:
        InvalidValue: fewer than one pole.
    """
    if poles < 1:
        raise InvalidValue(f"slowest_iteration(poles={poles!r}): expected at least one pole of the tracking law")
    angle = (poles - 1) * math.pi / (2 * poles)
    return math.sin(angle) ** poles * math.tan(angle)


def least_product(poles: int, rate: float, period: float) -> float:
    """Return the least a lambda with which the plain form is stable around a tracking law of that rate.

    It holds to first order in rate x period.

    Args:
        poles: N of the tracking law, as in `slowest_iteration`.
        rate: Lambda of the tracking law, 1/s.
        period: T of the control cycle, s.

    Raises:
        InvalidValue: fewer than one pole, a rate or a period that is not positive.
    """
    if not (0 < rate < math.inf and 0 < period < math.inf):
        raise InvalidValue(f"least_product(rate={rate!r}, period={period!r}): expected positive numbers, 1/s and s")
    return slowest_iteration(poles) * rate * period
