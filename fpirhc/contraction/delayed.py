"""How large a gain may be when the response is late, smoothed, or behind a map that saturates.

W(z) = sum_j w_j z^-j goes from request to response; the map pairs the response with its own value of d cycles earlier, and
filters the error with a pole.
"""

from __future__ import annotations

import math

import numpy as np

from fpirhc.contraction.spectrum import Array

_RANGE, _STEPS, _HALVINGS = (1e-3, 20.0), 100, 40  # of the gain times |lambda| that is searched
_INSIDE = 1 - 1e-9  # radius of roots that decay
_SPARE, _SPARE_OF_TWO_POLES = 1.25, 1.5


def delayed_limit(
    weights: Array,
    *,
    pairing: float = 0.0,
    leak: float = 0.0,
    pole: float = 0.0,
    eigenvalue: complex = 1.0,
    modelled: float = 0.0,
) -> float:
    """Return the effective gain up to which every gain converges; 0 when none does, infinite when all below 20 / |lambda| do.

        1 = p / z + (1 - p) [ z^-(1+d) - a F(z) E(z) ],     F = (1 - f) / (1 - f / z),     E = (lambda - m) W(z) + m z^-(1+d)

    It is where a root leaves the unit circle. A fraction of d interpolates between two requests. With a model of the right gain,
    lambda = m = 1, W drops out, and the limit is that without delay.

    Args:
        weights: w_1, w_2, ... of past requests in the response, dead time included.
        pairing: d, age of the request that a response is paired with, cycles.
        leak: p, dimensionless.
        pole: f of the filter of the error.
        eigenvalue: lambda of the response Jacobian; give -lambda for the limit of a negative gain.
        modelled: m, share of the model's response in the error: 1 in the model-referenced form, else 0.
    """
    at_zero, at_one = (loop_polynomial(weights, a, pairing, leak, pole, eigenvalue, modelled) for a in (0.0, 1.0))

    def stable(gain: float) -> bool:
        return bool(np.abs(np.roots(at_zero + gain * (at_one - at_zero))).max(initial=0.0) < _INSIDE)

    gains = np.geomspace(*_RANGE, _STEPS) / abs(eigenvalue)
    wrong = next((k for k, gain in enumerate(gains) if not stable(gain)), None)
    if wrong is None:
        return math.inf
    if wrong == 0:
        return 0.0
    low, high = float(gains[wrong - 1]), float(gains[wrong])
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def loop_polynomial(
    weights: Array, gain: float, pairing: float, leak: float, pole: float, eigenvalue: complex, modelled: float
) -> Array:
    """Return the coefficients in 1 / z of (1 - f / z) times (left side minus right side); arguments as in `delayed_limit`."""
    whole = math.floor(pairing + 1e-9)
    share = max(pairing - whole, 0.0)
    own = np.zeros(max(whole + 3, len(weights) + 1), dtype=complex)
    own[whole + 1], own[whole + 2] = 1 - share, share
    delayed = np.zeros_like(own)
    delayed[1 : len(weights) + 1] = weights
    smooth = np.array([1.0, -pole])
    error = (eigenvalue - modelled) * delayed + modelled * own
    left_side = np.convolve(smooth, [1.0, -leak])
    right_side = (1 - leak) * (np.convolve(smooth, own) - gain * (1 - pole) * np.append(error, 0.0))
    return np.asarray(np.pad(left_side, (0, right_side.size - left_side.size)) - right_side)


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
