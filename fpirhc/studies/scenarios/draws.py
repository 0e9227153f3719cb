"""Scenarios: exact parameters and noise that are the same for every controller of a comparison.

Scenario k of a seed is always the same: its numbers come from a stream of its own, `SeedSequence(seed, spawn_key=(use, k))`,
whatever the number of scenarios, of processes and of controllers, and in whatever order they run. Every exact parameter
is drawn from its range (see `fpirhc.plant.mismatch`): by its own spread, or without one multiplied by a factor of its own, the
logarithm of which is uniform between log(1 - P/100) and log(1 + P/100). Dead times are those of the problem, or P percent shorter
or longer, rounded away from it to whole cycles: another length of a queue is another loop, so there are three and no more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fpirhc.plant.mismatch import Parametric, drawn
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.task.problem import Problem

COMPARING, TUNING = 0, 1  # uses: a controller is never compared on the scenarios on which it was tuned


@dataclass(frozen=True, eq=False)
class Scenario:
    """One scenario.

    Args:
        seed: of the disturbances' noise.
        exact: exact parameters of the plant, shape (np,).
        mismatch: distance of the model from them, see `mismatch_of`.
        lateness: -1, 0 or 1: dead times are shorter by the whole percentage, as in the problem, or longer by it.
    """

    seed: int
    exact: np.ndarray
    mismatch: float
    lateness: int = 0


def draw(
    plant: Parametric, *, seed: int, use: int, number: int, percent: float, model: Parametric | None = None
) -> Scenario:
    """Return a scenario; its exact parameters lie in `exact_ranges(plant, percent)`.

    Args:
        plant: the plant that a run moves.
        seed: seed of the study.
        use: `COMPARING` or `TUNING`.
        number: number of the scenario.
        percent: range of the exact parameters, percent.
        model: the controllers' model, where it is another plant. The mismatch is then that of the parameters which both have.
    """
    parameters, noise, late = np.random.SeedSequence(seed, spawn_key=(use, number)).spawn(3)
    shares = np.random.default_rng(parameters).random(len(plant.parameters))
    values = [drawn(p, percent, float(s)) for p, s in zip(plant.parameters.values(), shares, strict=True)]
    exact = np.array(values, dtype=float)
    believed = _believed(model or plant)
    shared = [k for k, name in enumerate(plant.parameters) if name in believed]
    assumed = np.array([believed[name] for name in plant.parameters if name in believed])
    lateness = int(np.random.default_rng(late).integers(-1, 2))
    return Scenario(int(noise.generate_state(1)[0]), exact, mismatch_of(assumed, exact[shared]), lateness)


def _believed(model: Parametric) -> dict[str, float]:
    return {name: parameter.approximate for name, parameter in model.parameters.items()}


def mismatch_of(approximate: np.ndarray, exact: np.ndarray) -> float:
    """Return the rms over the parameters of |approximate - exact| / max(|approximate|, |exact|), as a share."""
    size = np.maximum(np.abs(approximate), np.abs(exact))
    shares = np.abs(approximate - exact) / np.where(size > 0, size, 1.0)
    return float(np.sqrt(np.mean(shares**2))) if shares.size else 0.0


def with_exact(problem: Problem, exact: np.ndarray) -> Problem:
    """Return the problem with other exact parameters, shape (np,): those of the reality where it has one.

    Raises:
        InvalidProblem: the plant is not invertible at the start with them, or one of them leaves its bounds.
        NotSupported: an external plant without parameters.
    """
    if problem.reality is not None:
        return replace(problem, reality=problem.reality.with_exact(exact))
    return replace(problem, plant=with_exact_parameters(problem.plant, exact))
