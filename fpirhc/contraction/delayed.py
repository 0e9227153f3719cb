"""How large a gain may be when the response is late, smoothed, or behind a map that saturates.

W(z) = sum_j w_j z^-j goes from request to response; the map pairs the response with its own value of d cycles earlier, and
filters the error with a pole. The derivations for large errors stand in docs/theory.md.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.contraction.spectrum import Array
from fpirhc.deformation.base import Iteration, Mirror

_NONE = 1e-9  # a damping below this counts as none
_DIGITS = 6  # decimals of the pairing in cycles, so that a number next to a whole one becomes whole
_PER_TERM = 256  # points of the unit circle per term of the polynomials
_LEAKING_PER_TERM = 64  # points of the unit circle per term of the polynomial
_STEPS, _HALVINGS = 400, 30
_AT_ONCE = 20  # gains, so that a search that ends early is short
_RANGE = 1e-3, 20.0  # of the gain times |lambda| that is searched
_SPARE, _SPARE_OF_TWO_POLES = 1.25, 1.5


def limit_behind_weights(
    iteration: Iteration, mirror: Mirror, weights: Array, pairing: float, eigenvalue: complex
) -> float:
    """Return the effective gain below which an iteration converges whose response has these weights of past requests.

    Args:
        weights: w_1, w_2, ... of past requests in the response, dead time included.
        pairing: age of the request that a response is paired with, cycles.
        eigenvalue: lambda of the response Jacobian; give -lambda for the limit of a negative gain.
    """
    pole, modelled = iteration.error_pole, mirror.share
    if not iteration.leak:
        return delayed_limit(weights, pairing=pairing, pole=pole, eigenvalue=eigenvalue, modelled=modelled)
    leak = iteration.leak
    return leaking_limit(weights, cycles=pairing, leak=leak, pole=pole, eigenvalue=eigenvalue, modelled=modelled)


def delayed_limit(
    weights: Array, *, pairing: float = 0.0, pole: float = 0.0, eigenvalue: complex = 1.0, modelled: float = 0.0
) -> float:
    """Return the effective gain below which the delayed iteration converges; 0 when no gain does.

        D(z) = (1 - p / z) (1 - z^-(1+d)) + a (1 - p) E(z) = 0,     E = (lambda - m) W(z) + m z^-(1+d)

    For a small a a root z0 of z0^(1+d) = 1 moves inwards when Re[(1 - p) E(z0) / (1 - p / z0)] > 0. With a larger gain the loop
    stays stable until a root meets the unit circle. A fraction of d interpolates between two requests.

    Args:
        weights: w_1, w_2, ... of past requests in the response.
        pairing: d, in cycles.
        pole: p of the filter of the error.
        eigenvalue: lambda of the response Jacobian; give -lambda for the limit of a negative gain.
        modelled: m, share of the model's response in the error: 1 in the model-referenced form, else 0.
    """
    pairing = round(pairing, _DIGITS)
    own = _late(pairing, len(weights) + 1)
    delayed = np.append(weights, np.zeros(own.size - len(weights) - 1))
    response = (1 - pole) * ((eigenvalue - modelled) * np.append(0.0, delayed) + modelled * own)
    iteration = np.convolve([1.0, -pole], np.append(1.0, -own[1:]))
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


def _late(cycles: float, least: int) -> Array:
    """Coefficients of z^-(1+d), at least so many."""
    whole = math.floor(cycles)
    coefficients = np.zeros(max(whole + 3, least))
    coefficients[whole + 1 : whole + 3] = 1 - (cycles - whole), cycles - whole
    return coefficients


def _at(coefficients: Array, angles: Array) -> Array:
    """Sum over j of c_j exp(-i j angle), for every angle."""
    return np.asarray(np.polynomial.polynomial.polyval(np.exp(-1j * angles), coefficients))


def _on_grid(coefficients: Array, size: int) -> Array:
    """`_at` at the angles (i + 1/2) 2 pi / size, with the first value repeated at the end."""
    shifted = coefficients * np.exp(-1j * np.pi * np.arange(coefficients.size) / size)
    values = np.fft.fft(shifted, size)
    return np.append(values, values[0])


def leaking_limit(
    weights: Array,
    *,
    cycles: float = 0.0,
    leak: float = 0.0,
    pole: float = 0.0,
    eigenvalue: complex = 1.0,
    modelled: float = 0.0,
) -> float:
    """Return the effective gain up to which every gain converges; 0 when none does, infinite when all below 20 / |lambda| do.

    The deformation leaks:

        1 = p / z + (1 - p) [ z^-(1+d) - a F(z) E(z) ],     F = (1 - f) / (1 - f / z),
        E = (lambda - m) W(z) + m z^-(1+d)                  m = 1: model-referenced, the model's response passes W too

    With a model of the right gain, lambda = 1, W drops out of the model-referenced form, and the limit is that without delay.

    Args:
        weights: w_1, w_2, ... of past requests in the response, dead time included.
        cycles: d, age of the deformation that the next one is paired with, cycles.
        leak: p, dimensionless.
        pole: f of the filter of the error.
        eigenvalue: lambda of the response Jacobian; give -lambda for the limit of a negative gain.
        modelled: m, share of the model's response in the error: 1 in the model-referenced form, else 0.
    """
    if complex(eigenvalue).real <= 0:
        return 0.0

    at_zero, at_one = (
        _on_circle(loop_polynomial(weights, gain, cycles, leak, pole, eigenvalue, modelled)) for gain in (0.0, 1.0)
    )

    def stable(gains: Array) -> Array:
        return _circled_nothing(at_zero + gains[:, np.newaxis] * (at_one - at_zero))

    gains = np.geomspace(*_RANGE, _STEPS) / abs(eigenvalue)
    wrong = next(
        (k + first for k in range(0, _STEPS, _AT_ONCE) for first in np.flatnonzero(~stable(gains[k : k + _AT_ONCE]))),
        None,
    )
    if wrong is None:
        return math.inf
    low, high = (float(gains[wrong - 1]) if wrong else 0.0), float(gains[wrong])
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(np.array([middle]))[0] else (low, middle)
    return low


def loop_polynomial(
    weights: Array, gain: float, cycles: float, leak: float, pole: float, eigenvalue: complex, modelled: float
) -> Array:
    """Return the coefficients in 1 / z of (1 - f / z) times (left side minus right side); arguments as in `leaking_limit`."""
    whole = math.floor(cycles + 1e-9)
    share = max(cycles - whole, 0.0)
    own = np.zeros(max(whole + 3, len(weights) + 1), dtype=complex)
    own[whole + 1], own[whole + 2] = 1 - share, share
    delayed = np.zeros_like(own)
    delayed[1 : len(weights) + 1] = weights
    smooth = np.array([1.0, -pole])
    error = (eigenvalue - modelled) * delayed + modelled * own
    left_side = np.convolve(smooth, [1.0, -leak])
    right_side = (1 - leak) * (np.convolve(smooth, own) - gain * (1 - pole) * np.append(error, 0.0))
    return np.asarray(np.pad(left_side, (0, right_side.size - left_side.size)) - right_side)


def _on_circle(coefficients: Array) -> Array:
    """The polynomial in 1 / z at points round the unit circle."""
    return np.fft.fft(coefficients, 2 ** math.ceil(math.log2(_LEAKING_PER_TERM * coefficients.size)))


def _circled_nothing(curves: Array) -> Array:
    """Whether all roots are inside the unit circle, a curve a row: it does not go round zero."""
    turned = np.angle(np.roll(curves, -1, axis=1) * np.conj(curves)).sum(axis=1) / (2 * np.pi)
    return (np.abs(curves).min(axis=1) >= 1e-12) & (np.abs(turned) < 0.5)


def step_for_basin(largest_error: float, poles: int, rate: float, period: float) -> float:
    """Return the step per cycle that a map needs to come back from an error of that size, with its spare factor.

    The plain form is stable around a tracking law with N poles at -Lambda, to first order in Lambda T, where
    a lambda / (T Lambda) > sin(theta)^N tan(theta), theta = (N - 1) pi / (2 N): 0, 1/2, 9/8, 1.759, 2.395 for N = 1 ... 5.

    Args:
        largest_error: |f - d|, in units of the response.
        poles: N of the tracking law: n + 1 for relative order n with the integral, n without it.
        rate: Lambda of the tracking law, 1/s.
        period: T of the control cycle, s.
    """
    angle = (poles - 1) * math.pi / (2 * poles)
    spare = _SPARE_OF_TWO_POLES if poles == 2 else _SPARE
    return spare * math.sin(angle) ** poles * math.tan(angle) * rate * period * largest_error
