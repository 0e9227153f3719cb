"""How large a gain may be when the response is an average of several past requests.

With the estimated response f_k = lambda sum_j w_j r_{k-j}, a map with effective gain a that pairs it with the request of 1 + d
cycles ago and filters the error with the pole p, the request follows

    r_k = r_{k-1-d} - a g_k,     g_k = p g_{k-1} + (1 - p) f_k,
    D(z) = (1 - p / z) (1 - z^-(1+d)) + a lambda (1 - p) sum_j w_j z^-j = 0,

where a fraction of d interpolates between two requests. For small a lambda a root z0 of z0^(1+d) = 1 moves inwards when
Re[lambda (1 - p) W(z0) / (1 - p / z0)] > 0. With a larger gain the loop stays stable until a root meets the unit circle.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.contraction.spectrum import Array

_NONE = 1e-9  # a damping below this counts as none
_DIGITS = 6  # decimals of the pairing in cycles, so that a number next to a whole one becomes whole
_PER_TERM = 256  # points of the unit circle per term of the polynomials


def delayed_limit(weights: Array, *, pairing: float = 0.0, pole: float = 0.0, eigenvalue: complex = 1.0) -> float:
    """Return the effective gain below which the delayed iteration converges; 0 when no gain does.

    Args:
        weights: w_1, w_2, ... of past requests in the response.
        pairing: d, in cycles.
        pole: p of the filter of the error.
        eigenvalue: lambda of the response Jacobian; give -lambda for the limit of a negative gain.
    """
    pairing = round(pairing, _DIGITS)
    response = eigenvalue * (1 - pole) * np.append(0.0, weights)
    iteration = np.convolve([1.0, -pole], _pairing(pairing))
    # A fraction of a cycle damps all but the constant request.
    count = 1 if pairing % 1 else round(pairing) + 1
    first = 2 * np.pi * np.arange(count) / count
    turning = _at(response, first) / _at(np.array([1.0, -pole]), first)
    if np.any(turning.real <= _NONE * abs(eigenvalue)):
        return 0.0
    # Half a cell off, so that neither z = 1 nor z = -1 is a point of the grid.
    size = 2 ** math.ceil(math.log2(_PER_TERM * (iteration.size + response.size)))
    angles = 2 * np.pi * (np.arange(size + 1) + 0.5) / size
    product = -_on_grid(iteration, size) * np.conj(_on_grid(response, size))
    crosses = (product.imag[:-1] * product.imag[1:] <= 0) & (product.real[:-1] > 0) & (product.real[1:] > 0)
    share = product.imag[:-1][crosses] / (product.imag[:-1] - product.imag[1:])[crosses]
    meeting = angles[:-1][crosses] + share * 2 * np.pi / size
    # Roots that begin on the circle do not cross it at their first place.
    turns = meeting * count / (2 * np.pi)
    meeting = meeting[np.abs(turns - np.round(turns)) > count / size]
    if not meeting.size:
        return math.inf
    return float(np.min(np.abs(_at(iteration, meeting) / _at(response, meeting))))


def _pairing(cycles: float) -> Array:
    """Coefficients of 1 - z^-(1+d)."""
    whole = math.floor(cycles)
    share = cycles - whole
    coefficients = np.zeros(whole + 3)
    coefficients[0] = 1.0
    coefficients[whole + 1] -= 1 - share
    coefficients[whole + 2] -= share
    return coefficients


def _at(coefficients: Array, angles: Array) -> Array:
    """Sum over j of c_j exp(-i j angle), for every angle."""
    return np.asarray(np.polynomial.polynomial.polyval(np.exp(-1j * angles), coefficients))


def _on_grid(coefficients: Array, size: int) -> Array:
    """`_at` at the angles (i + 1/2) 2 pi / size, with the first value repeated at the end."""
    shifted = coefficients * np.exp(-1j * np.pi * np.arange(coefficients.size) / size)
    values = np.fft.fft(shifted, size)
    return np.append(values, values[0])
