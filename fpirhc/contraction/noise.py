"""What white noise of the measured response does to the request, and the gain that a budget of chatter allows.

With the error filtered by the pole p and the effective gain a, on f = J r with noise n of covariance N,

    g_k = p g_{k-1} + (1 - p)(J r_{k-1} + n_k),     r_k = r_{k-1} - a g_k,

is a linear system whose stationary covariance solves a Lyapunov equation. For one coordinate, with g = a lambda,

    Var r               = a^2 (1 + p) / (g (2 (1 + p) - g (1 - p))) sigma^2,
    Var (r_k - r_{k-1}) = 2 a^2 (1 - p) / (2 (1 + p) - g (1 - p)) sigma^2.

A drift of the task leaves an error proportional to 1 / g whatever the pole is, so a filter that allows a larger gain lowers the
error. A budget B of step variance per noise variance allows a = sqrt(B) without a filter, and a = (2 kappa B / lambda)^(1/3) to
first order with kappa = g / (1 - p) held. kappa sets the damping of the iteration, zeta = 1 / (2 sqrt(kappa)). Beyond kappa = 8 the
error falls no further, because the noise that the plant follows remains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fpirhc.contraction.spectrum import Array
from fpirhc.errors import InvalidShape, InvalidValue, NotContractive

_BISECTIONS = 60


@dataclass(frozen=True, eq=False)
class NoiseSpread:
    """Covariances of the request and of its step per cycle.

    Args:
        request: covariance of r, shape (n, n), in the unit of the response squared.
        step: covariance of r_k - r_{k-1}, shape (n, n), in the same unit.
    """

    request: Array
    step: Array


def request_variance(gain: float, pole: float, eigenvalue: float = 1.0) -> float:
    """Return Var r / sigma^2 for one coordinate; the equation stands at the top of the module.

    Args:
        gain: effective gain a.
        pole: p of the filter of the error, in [0, 1).
        eigenvalue: lambda of the response Jacobian.

    Raises:
        NotContractive: gain and pole outside 0 < a lambda < 2 (1 + p) / (1 - p).
    """
    product = _stable_product(gain, pole, eigenvalue)
    return gain**2 * (1 + pole) / (product * (2 * (1 + pole) - product * (1 - pole)))


def step_variance(gain: float, pole: float, eigenvalue: float = 1.0) -> float:
    """Return Var(r_k - r_{k-1}) / sigma^2 for one coordinate; the equation stands at the top of the module.

    Args:
        gain: effective gain a.
        pole: p of the filter of the error, in [0, 1).
        eigenvalue: lambda of the response Jacobian.

    Raises:
        NotContractive: gain and pole outside 0 < a lambda < 2 (1 + p) / (1 - p).
    """
    product = _stable_product(gain, pole, eigenvalue)
    return 2 * gain**2 * (1 - pole) / (2 * (1 + pole) - product * (1 - pole))


def noise_spread(jacobian: Array, noise: Array, gain: float, pole: float) -> NoiseSpread:
    """Return the covariances for several coordinates.

    Args:
        jacobian: J, shape (n, n), dimensionless.
        noise: covariance of the noise of the response, shape (n, n), in the unit of the response squared.
        gain: effective gain a.
        pole: p of the filter of the error, in [0, 1).

    Raises:
        InvalidShape: matrices that do not fit.
        NotContractive: a loop that is not stable.
    """
    j, covariance = np.atleast_2d(jacobian), np.atleast_2d(noise)
    if j.shape != covariance.shape or j.shape[0] != j.shape[1]:
        raise InvalidShape(f"jacobian {j.shape} and noise {covariance.shape}: expected two square matrices of one size")
    one, share = np.eye(len(j)), 1 - pole
    loop = np.block([[one - gain * share * j, -gain * pole * one], [share * j, pole * one]])
    radius = float(np.abs(np.linalg.eigvals(loop)).max())
    if not radius < 1:
        raise NotContractive(
            f"gain {gain:.4g} with the filter's pole {pole:.4g}: an error changes by {radius:.4g} per cycle, so noise grows; lower "
            "the gain"
        )
    entry = share * np.vstack([-gain * one, one])
    from scipy.linalg import solve_discrete_lyapunov  # it takes longer to import than a problem to load

    spread = solve_discrete_lyapunov(loop, entry @ covariance @ entry.T)
    n = len(j)
    return NoiseSpread(spread[:n, :n], gain**2 * spread[n:, n:])


def gain_within_chatter(budget: float, ringing: float, eigenvalue: float = 1.0) -> tuple[float, float]:
    """Return (effective gain a, filter pole p) with `step_variance` equal to the budget, for one coordinate.

    The gain is at most the deadbeat gain 1 / lambda, where the error is smallest. There the variance is below the budget.

    Args:
        budget: B, step variance per noise variance.
        ringing: kappa = a lambda / (1 - p), usually 4 to 8; 0 for no filter.
        eigenvalue: lambda of the response Jacobian.

    Raises:
        InvalidValue: a budget that is not positive, a negative ringing, an eigenvalue that is not positive.
    """
    if not (0 < budget < math.inf and ringing >= 0 and 0 < eigenvalue < math.inf):
        raise InvalidValue(
            f"gain_within_chatter(budget={budget!r}, ringing={ringing!r}, eigenvalue={eigenvalue!r}): expected a positive budget "
            "and eigenvalue, and a ringing of at least 0"
        )
    low, high = 0.0, 1 / eigenvalue
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        fits = step_variance(middle, filter_pole(middle * eigenvalue, ringing), eigenvalue) <= budget
        low, high = (middle, high) if fits else (low, middle)
    return low, filter_pole(low * eigenvalue, ringing)


def filter_pole(product: float, ringing: float) -> float:
    """Return p with a lambda / (1 - p) = ringing; 0 where the product exceeds the ringing, and where the ringing is 0."""
    return max(0.0, 1 - product / ringing) if ringing else 0.0


def _stable_product(gain: float, pole: float, eigenvalue: float) -> float:
    product = gain * eigenvalue
    if not (0 <= pole < 1 and 0 < product < 2 * (1 + pole) / (1 - pole)):
        raise NotContractive(
            f"gain {gain:.4g} with eigenvalue {eigenvalue:.4g} and the filter's pole {pole:.4g}: expected a pole in [0, 1) and a "
            "product between 0 and 2 (1 + p) / (1 - p)"
        )
    return product
