"""Scenarios: the exact parameters and the noise that every controller of a comparison meets alike.

Scenario k of a seed is always the same: its numbers come from a stream of its own, `SeedSequence(seed, spawn_key=(use, k))`,
whatever the number of scenarios, of processes and of controllers, and in whatever order they run. Every exact parameter
is multiplied by a factor of its own, log-uniform between 1 - P and 1 + P: log(factor) is uniform between log(1 - P) and
log(1 + P). A parameter keeps its sign, and one that is zero stays zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.plant import Plant
from fpirhc.task.problem import Problem

COMPARING, TUNING = 0, 1  # uses: what a controller was tuned on is never what it is compared on


@dataclass(frozen=True, eq=False)
class Scenario:
    """What one scenario is made of.

    Parameters:
        seed: of the disturbances' noise. exact: parameters of the plant, shape (np,). mismatch: see `mismatch_of`.
    """

    seed: int
    exact: np.ndarray
    mismatch: float


def draw(plant: Plant, *, seed: int, use: int, number: int, percent: float) -> Scenario:
    """Return scenario `number` of `seed`; the exact parameters lie within `percent` of the plant's."""
    parameters, noise = np.random.SeedSequence(seed, spawn_key=(use, number)).spawn(2)
    low, high = math.log1p(-percent / 100), math.log1p(percent / 100)
    factors = np.exp(np.random.default_rng(parameters).uniform(low, high, plant.exact.size))
    exact = plant.exact * (factors if percent else 1.0)
    return Scenario(int(noise.generate_state(1)[0]), exact, mismatch_of(plant.approximate, exact))


def mismatch_of(approximate: np.ndarray, exact: np.ndarray) -> float:
    """How wrong a model is: rms over its parameters of |approximate - exact| / max(|approximate|, |exact|), as a share."""
    size = np.maximum(np.abs(approximate), np.abs(exact))
    shares = np.abs(approximate - exact) / np.where(size > 0, size, 1.0)
    return float(np.sqrt(np.mean(shares**2))) if shares.size else 0.0


def with_exact(problem: Problem, exact: np.ndarray) -> Problem:
    """Return the problem with other exact parameters, shape (np,).

    Raises:
        InvalidProblem: the plant is not invertible at the start with them, or one of them leaves its bounds.
    """
    return replace(problem, plant=problem.plant.with_exact(exact))


def check_percent(plant: Plant, percent: float) -> None:
    """Raise if factors cannot be drawn, or if some draw could leave a parameter's physical bounds.

    Raises:
        InvalidValue: `percent` outside [0, 100). InvalidProblem: the parameters' names, and how far they may be drawn.
    """
    if not 0 <= percent < 100:
        raise InvalidValue(
            f"mismatch {percent!r}: expected a percentage of at least 0 and below 100; a factor of zero has no meaning"
        )
    mistakes = Mistakes("mismatch")
    for name, parameter in plant.parameters.items():
        ends = sorted(parameter.exact * (1 + sign * percent / 100) for sign in (-1, 1))
        low, high = parameter.bounds
        if ends[0] < low or ends[1] > high:
            mistakes.add(
                f"parameter '{name}': draws within {percent:g} % of {parameter.exact:g} reach from {ends[0]:g} to {ends[1]:g} "
                f"{parameter.unit}, outside its bounds ({low:g}, {high:g}); at most {_most(parameter.exact, low, high):.3g} % "
                "stay inside"
            )
    mistakes.raise_if_any()


def _most(exact: float, low: float, high: float) -> float:
    return 100 * min(abs(exact - low), abs(high - exact)) / abs(exact)
