"""How large a gain may be when the response is an average of several past requests.

With the estimated response f_k = lambda sum_j w_j r_{k-j}, a map with effective gain a that pairs it with the request of 1 + d
cycles ago and filters the error with the pole p, the request follows

    r_k = r_{k-1-d} - a g_k,     g_k = p g_{k-1} + (1 - p) f_k,
    D(z) = (1 - p / z) (1 - z^-(1+d)) + a lambda (1 - p) sum_j w_j z^-j = 0,

a fraction of d interpolating between two requests. For small a lambda a root z0 of z0^(1+d) = 1 moves inwards when
Re[lambda (1 - p) W(z0) / (1 - p / z0)] > 0; from there on the loop stays stable until a root meets the unit circle.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.contraction.spectrum import Array

_NONE = 1e-9  # a damping below this is none
_DIGITS = 6  # of the pairing in cycles: what is nearer to a whole number is one
_PER_TERM = 256  # points of the unit circle per term of the polynomials


def delayed_limit(weights: Array, *, pairing: float = 0.0, pole: float = 0.0, eigenvalue: complex = 1.0) -> float:
    """Return the effective gain below which the delayed iteration converges; 0 when no gain does.

    Parameters: `weights` w_1, w_2, ... of past requests in the response; `pairing` d in cycles; `pole` of the error's filter;
    `eigenvalue` lambda of the response Jacobian. A negative gain is that of -lambda.
    """
    pairing = round(pairing, _DIGITS)
    answered = eigenvalue * (1 - pole) * np.append(0.0, weights)
    asked = np.convolve([1.0, -pole], _pairing(pairing))
    # A fraction of a cycle damps all but the constant request.
    count = 1 if pairing % 1 else round(pairing) + 1
    first = 2 * np.pi * np.arange(count) / count
    turning = _at(answered, first) / _at(np.array([1.0, -pole]), first)
    if np.any(turning.real <= _NONE * abs(eigenvalue)):
        return 0.0
    # Half a cell off, so that neither z = 1 nor z = -1 is a point of the grid.
    size = 2 ** math.ceil(math.log2(_PER_TERM * (asked.size + answered.size)))
    angles = 2 * np.pi * (np.arange(size + 1) + 0.5) / size
    product = -_on_grid(asked, size) * np.conj(_on_grid(answered, size))
    crosses = (product.imag[:-1] * product.imag[1:] <= 0) & (product.real[:-1] > 0) & (product.real[1:] > 0)
    share = product.imag[:-1][crosses] / (product.imag[:-1] - product.imag[1:])[crosses]
    meeting = angles[:-1][crosses] + share * 2 * np.pi / size
    # The roots that begin on the circle cross nothing there.
    turns = meeting * count / (2 * np.pi)
    meeting = meeting[np.abs(turns - np.round(turns)) > count / size]
    if not meeting.size:
        return math.inf
    return float(np.min(np.abs(_at(asked, meeting) / _at(answered, meeting))))


def _pairing(cycles: float) -> Array:
    """Coefficients of 1 - z^-(1+d)."""
    whole = math.floor(cycles)
    share = cycles - whole
    found = np.zeros(whole + 3)
    found[0] = 1.0
    found[whole + 1] -= 1 - share
    found[whole + 2] -= share
    return found


def _at(coefficients: Array, angles: Array) -> Array:
    """Sum of c_j exp(-i j angle)."""
    return np.asarray(np.polynomial.polynomial.polyval(np.exp(-1j * angles), coefficients))


def _on_grid(coefficients: Array, size: int) -> Array:
    """The same at the angles (i + 1/2) 2 pi / size, closed."""
    shifted = coefficients * np.exp(-1j * np.pi * np.arange(coefficients.size) / size)
    found = np.fft.fft(shifted, size)
    return np.append(found, found[0])
