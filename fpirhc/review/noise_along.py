"""What noise of the measured response does to the commands, along the reference: `contraction.noise` at some of its points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.contraction.noise import noise_spread
from fpirhc.contraction.spectrum import response_jacobians
from fpirhc.controllers.base import Controller
from fpirhc.errors import InvalidName, InvalidValue, NotContractive, NotSupported, nearest
from fpirhc.review.grid import ReviewGrid
from fpirhc.sensing.base import response_names
from fpirhc.task.problem import Problem

_POINTS = 9
_DRAWN = 20_000


@dataclass(frozen=True, eq=False)
class Noisy:
    """Points of the reference; build it with `noisy_points`.

    Parameters: jacobians J (points, n, n), inverses: the model's inputs per unit of response (points, nu, n),
    covariance (n, n) of the noise.
    """

    jacobians: np.ndarray
    inverses: np.ndarray
    covariance: np.ndarray

    def steps(self, gain: float, pole: float) -> np.ndarray:
        """Return the rms step of every input (nu,), the largest of all points.

        Raises:
            NotContractive: gain and pole with which noise grows.
        """
        spreads = [noise_spread(j, self.covariance, gain, pole).step for j in self.jacobians]
        covariances = [b @ s @ b.T for b, s in zip(self.inverses, spreads, strict=True)]
        return np.asarray(np.sqrt(np.max([np.diag(m) for m in covariances], axis=0)))


def noisy_points(grid: ReviewGrid, controller: Controller, noise: Mapping[str, float] | None) -> Noisy:
    """Return the points with the noise of the problem's sensors, or the given one.

    Parameters: `controller`, resolved; `noise`: standard deviation of the measured response by controlled coordinate.

    Raises:
        InvalidValue: no noise, a negative one. InvalidName: an unknown coordinate. NotSupported: a response that is
        estimated, whose noise must be given. NotContractive: no finite response Jacobian.
    """
    jacobians, inverses = _along_the_reference(
        grid, controller.plant_model(grid.problem).parameters(grid.problem.plant)
    )
    return Noisy(jacobians, inverses, np.diag(_deviations(grid.problem, noise) ** 2))


def chatter_of(grid: ReviewGrid, controller: Controller, gain: float, pole: float) -> dict[str, float]:
    """Return, by input, the rms step of the command per cycle that the noise of the problem's sensors causes.

    Parameters: `controller`, resolved; effective `gain` and `pole` of the filter of its error.

    Raises:
        InvalidValue, NotSupported, NotContractive: as `noisy_points`.
    """
    noisy = noisy_points(grid, controller, None)
    return dict(zip(grid.problem.plant.inputs, map(float, noisy.steps(gain, pole)), strict=True))


def _deviations(problem: Problem, noise: Mapping[str, float] | None) -> np.ndarray:
    """Standard deviation of every controlled coordinate's measured response."""
    names = problem.plant.controlled_names
    spreads = _of_sensors(problem) if noise is None else noise
    for name, value in spreads.items():
        if name not in names:
            raise InvalidName(f"suggest(noise=...): coordinate '{name}' is not controlled.{nearest(name, names)}")
        if not 0 <= value < math.inf:
            raise InvalidValue(
                f"suggest(noise=...): {value!r} for '{name}'; expected a standard deviation of at least 0"
            )
    levels = np.array([float(spreads.get(name, 0.0)) for name in names])
    if not levels.any():
        raise InvalidValue(
            "suggest: no response has noise, so no gain chatters; give noise={'"
            + names[0]
            + "': ...}, the standard deviation of "
            "the measured response"
        )
    return levels


def _of_sensors(problem: Problem) -> dict[str, float]:
    """Deviation of the noise of the sensors that measure responses."""
    plant, sensing = problem.plant, problem.sensing
    measured = dict(zip(response_names(plant), plant.controlled_names, strict=True))
    if sensing.sensors and not set(measured) & set(sensing.measures(plant)):
        raise NotSupported(
            f"suggest: the response is estimated by {type(sensing.estimator).__name__}, whose noise is not white; give "
            "noise={coordinate: standard deviation of the estimated response}"
        )
    times = problem.period * np.arange(_DRAWN)
    noises = {measured[name]: sensor.noise for name, sensor in sensing.sensors.items() if name in measured}
    random = np.random.default_rng(0)
    return {c: float(np.std(n.values(times, random))) for c, n in noises.items() if n is not None}


def _along_the_reference(grid: ReviewGrid, believed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Response Jacobians (points, n, n), and the model's inputs per unit of response (points, nu, n), where all are finite."""
    plant = grid.problem.plant
    places = np.unique(np.linspace(0, len(grid.times) - 1, _POINTS).astype(int))
    exact = np.tile(grid.draws[0], (len(places), 1))
    jacobians = response_jacobians(plant, grid.states[places], grid.requests(believed)[places], exact, believed)
    x, u, p = plant.symbols()
    slope = ca.Function("fpirhc_gain", [x, u, p], [ca.jacobian(plant.equations.controlled_response(x, u, p), u)])
    gains = [np.asarray(slope(grid.states[k], grid.commands[0, k], believed).full()) for k in places]
    usable = [k for k in range(len(places)) if np.isfinite(jacobians[k]).all() and np.isfinite(gains[k]).all()]
    if not usable:
        raise NotContractive(
            "the response Jacobian is finite nowhere along the reference; see whether the problem is well posed"
        )
    return jacobians[usable], np.array([np.linalg.inv(gains[k]) for k in usable])
