"""Sampled loops around a linear response that the model does not know, as one matrix per cycle, from their definition."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.linalg import expm


def lag(tau: float, eigenvalue: float = 1.0):
    """(A, b, c) of f = eigenvalue r / (tau s + 1)."""
    return np.array([[-1 / tau]]), np.array([eigenvalue / tau]), np.array([1.0])


def resonance(frequency: float, damping: float, eigenvalue: float = 1.0):
    """(A, b, c) of f = eigenvalue r w^2 / (s^2 + 2 damping w s + w^2)."""
    a = np.array([[0.0, 1.0], [-(frequency**2), -2 * damping * frequency]])
    return a, np.array([0.0, eigenvalue * frequency**2]), np.array([1.0, 0.0])


def poles(response, order: int, rate: float, period: float, gain: float, *, plain: bool) -> np.ndarray:
    """Poles of the loop of y^(order) = f, the exponential tracking law with integral, and the affine map in either form."""
    a, b, c = response
    n, m = order, len(b)
    whole = np.zeros((n + m + 1, n + m + 1))
    whole[range(n - 1), range(1, n)] = 1.0
    whole[n - 1, n : n + m] = c
    whole[n : n + m, n : n + m], whole[n : n + m, -1] = a, b
    transition = expm(whole * period)
    gains = [math.comb(n + 1, s) * rate ** (n + 1 - s) for s in range(n + 1)]

    def cycle(z: np.ndarray) -> np.ndarray:
        x, integral, request, wish = z[: n + m], z[-3], z[-2], z[-1]
        realised = c @ x[n:]
        desired = -(gains[0] * integral + np.dot(gains[1:], x[:n]))
        error = realised - (desired if plain else wish)
        next_value = (request if plain else desired + request - wish) - gain * error
        state = transition[:-1, :-1] @ x + transition[:-1, -1] * next_value
        return np.concatenate([state, [integral + period * x[0], next_value, desired]])

    size = n + m + 3
    return np.linalg.eigvals(np.column_stack([cycle(e) for e in np.eye(size)]))


def edge(stable: Callable[[float], bool], low: float, high: float) -> float:
    """The value at which something stable at `low` becomes unstable, or at `high` stable, by bisection."""
    first = stable(low)
    assert first != stable(high)
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) == first else (low, middle)
    return 0.5 * (low + high)
