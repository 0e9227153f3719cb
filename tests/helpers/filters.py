"""The extended Kalman filter of the books in numpy, with Jacobians by the complex step, beside which observers are tested."""

from collections.abc import Callable
from typing import Any

import numpy as np

import fpirhc as fp
from helpers.replay import samples

State = Any


def runge_kutta(rate: Callable[[State, Any, State], State], h: float) -> Callable[[State, Any, State], State]:
    """The classical method's step (x, u, w) -> x of a rate."""

    def step(x: State, u: Any, w: State) -> State:
        k1 = rate(x, u, w)
        k2 = rate(x + h / 2 * k1, u, w)
        k3 = rate(x + h / 2 * k2, u, w)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u, w))

    return step


def slope(function: Callable[[State], State], at: np.ndarray) -> np.ndarray:
    """The Jacobian of a real-analytic function."""
    return np.column_stack([np.atleast_1d(function(at + 1e-30j * e)).imag / 1e-30 for e in np.eye(at.size)])


def extended_filter(
    result: fp.Run,
    step: Callable[[State, Any, State], State],
    shown: Callable[[State], State],
    start: tuple[np.ndarray, np.ndarray],
    noise: np.ndarray,
    measured: float,
) -> tuple[np.ndarray, np.ndarray]:
    """States of every cycle and the last covariance, from the raw measurements and commands of a run."""
    x, p, states = start[0], np.diag(start[1]) ** 2, []
    for k, sample in enumerate(samples(result)):
        x, p = _predicted(step, x, p, result["command"][k - 1, 0], noise) if k else (x, p)
        c = slope(shown, x)
        gain = p @ c.T / (c @ p @ c.T + measured**2)
        x, p = x + gain @ (sample - shown(x)), p - gain @ c @ p
        states.append(x)
    return np.array(states), p


def _predicted(
    step: Callable[[State, Any, State], State], x: np.ndarray, p: np.ndarray, u: float, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    still = np.zeros(noise.size)
    a, b = slope(lambda z: step(z, u, still), x), slope(lambda w: step(x, u, w), still)
    return step(x, u, still), a @ p @ a.T + b @ np.diag(noise) ** 2 @ b.T
