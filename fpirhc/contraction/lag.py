"""A first-order lag between request and response: one that the model lacks, and one that the pairing contains.

With the lag tau and rho = exp(-T / tau) the response is f_k = rho f_{k-1} + (1 - rho) lambda r_{k-1}.

Unknown lag, inner iteration alone:  z^2 - (1 + rho - g (1 - rho)) z + rho = 0, g = a lambda. The limit grows to
g < 2 coth(T / (2 tau)): a lag makes the iteration swing, |z| = sqrt(rho), but does not lower the limit. A tracking law with N poles
at -Lambda around it is made unstable by the swing. In continuous time, with lambda = 1, the characteristic polynomials are

    plain                          tau s^(N+2) + s^(N+1) + w (s + Lambda)^N
    increment, model-referenced    tau s^(N+2) + (s + w) (s + Lambda)^N,

and the fast pair of both is the pair of roots of tau s^2 + (1 - N Lambda tau) s + w: for large s, w (1 + Lambda / s)^N =
w + w N Lambda / s, and 1 / s = -(tau / w) s on the pair. So for a fast iteration the loop is stable while N Lambda tau < 1,
whatever the gain, and a pair of damping zeta needs g <= (T / tau) ((1 - N Lambda tau) / (2 zeta))^2.

Paired through the lag (the response m of the model passes the same lag), delta_k = (1 - a) delta_{k-1} - a (f_k - m_k):

    (z - 1 + a)(z - rho) + a (1 - rho)(lambda - 1) z = 0,    stable for  lambda < 1 + (2 - a)(1 + rho) / (a (1 - rho)),

and in continuous time (s + w)(tau s + 1) + (lambda - 1) w has damping (1 + w tau) / (2 sqrt(lambda w tau)) >= 1 /
sqrt(lambda) at any w, because 1 + w tau >= 2 sqrt(w tau).
"""

from __future__ import annotations

import math

from fpirhc.errors import InvalidValue

_BISECTIONS = 60


def lagged_limit(period: float, lag: float) -> float:
    """Return the limit of a lambda of the inner iteration behind an unknown lag, 2 coth(T / (2 tau)); 2 without a lag.

    Args:
        period: T of the control cycle, s.
        lag: tau, s.

    Raises:
        InvalidValue: a period that is not positive, a negative lag.
    """
    _check(period, lag)
    return 2 / math.tanh(period / (2 * lag)) if lag else 2.0


def fastest_rate(poles: int, lag: float) -> float:
    """Return the rate Lambda = 1 / (N tau), 1/s, of a tracking law at which a fast iteration behind an unknown lag turns unstable.

    It holds to first order in rate x period.

    Args:
        poles: N of the tracking law.
        lag: tau, s.

    Raises:
        InvalidValue: fewer than one pole, a negative lag.
    """
    _check(1.0, lag, poles)
    return 1 / (poles * lag) if lag else math.inf


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


def through_lag_limit(period: float, lag: float, gain: float) -> float:
    """Return the largest eigenvalue lambda with which a response paired through the same lag converges.

    Args:
        period: T of the control cycle, s.
        lag: tau, s.
        gain: effective gain a, in (0, 2).

    Raises:
        InvalidValue: a period that is not positive, a negative lag, a gain outside (0, 2).
    """
    _check(period, lag)
    if not 0 < gain < 2:
        raise InvalidValue(f"through_lag_limit(gain={gain!r}): expected an effective gain between 0 and 2")
    decay = math.exp(-period / lag) if lag else 0.0
    return 1 + (2 - gain) * (1 + decay) / (gain * (1 - decay))


def through_lag_damping(eigenvalue: float) -> float:
    """Return the least damping, over all gains, of a response paired through the right lag: 1 / sqrt(lambda), at most 1.

    Args:
        eigenvalue: lambda of the response Jacobian.

    Raises:
        InvalidValue: an eigenvalue that is not positive.
    """
    if not 0 < eigenvalue < math.inf:
        raise InvalidValue(f"through_lag_damping(eigenvalue={eigenvalue!r}): expected a positive number")
    return min(1.0, 1 / math.sqrt(eigenvalue))


def _check(period: float, lag: float, poles: int = 1) -> None:
    if not (0 < period < math.inf and 0 <= lag < math.inf and poles >= 1):
        raise InvalidValue(
            f"period={period!r}, lag={lag!r}, poles={poles!r}: expected a positive period and a lag of at least 0, s, and at least "
            "one pole of the tracking law"
        )
