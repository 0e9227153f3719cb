"""What white noise of the measured response does to the request, cycle by cycle (docs/theory-robust.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.contraction.spectrum import Array
from fpirhc.errors import InvalidShape, NotContractive


@dataclass(frozen=True, eq=False)
class NoiseSpread:
    """Covariances of the request and of its step per cycle.

    Args:
        request: covariance of r, shape (n, n), in the unit of the response squared.
        step: covariance of r_k - r_{k-1}, shape (n, n), in the same unit.
    """

    request: Array
    step: Array


def noise_spread(jacobian: Array, noise: Array, gain: float, pole: float) -> NoiseSpread:
    """Return the stationary covariances of g_k = p g_{k-1} + (1 - p)(J r_{k-1} + n_k), r_k = r_{k-1} - a g_k.

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


def filter_pole(product: float, ringing: float) -> float:
    """Return p with a lambda / (1 - p) = ringing; 0 where the product exceeds the ringing, and where the ringing is 0."""
    return max(0.0, 1 - product / ringing) if ringing else 0.0
