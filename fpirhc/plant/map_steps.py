"""The motion of a map: its own steps, which no integrator approximates."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fpirhc.plant.integrators import Integrator, RungeKutta4
from fpirhc.plant.plant import Plant


@dataclass(frozen=True)
class MapSteps(Integrator):
    """What stands in the place of an integrator where the plant is a map: x+ = f(x, u, p), as often as the time has steps.

    `Problem` and `Horizon` have it for a map by themselves.
    """

    @property
    def steps_maps(self) -> bool:
        """Whether it moves maps: it does."""
        return True

    def step(self, plant: Plant, period: float) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state after `period`, a whole number of the plant's cycles."""
        x, u, p = plant.symbols()
        w, after = ca.SX.sym("w", len(plant.names)), x
        for _ in range(max(1, round(period / plant.sampling))):
            after = plant.next_function(after, u, p, w)
        return ca.Function("fpirhc_map", [x, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])


def one_step(plant: Plant, period: float) -> ca.Function:
    """Function (state, input, parameters, forcing) -> state one cycle later: one Runge-Kutta step, or the cycle of a map."""
    return motion_of(plant, RungeKutta4(), RungeKutta4()).step(plant, period)


def motion_of(plant: Plant, integrator: Integrator, usual: Integrator) -> Integrator:
    """Return what moves a plant: the integrator where it fits the plant, else the steps of a map, or the usual integrator.

    Args:
        plant: that moves.
        integrator: of the problem, which may be that of another plant.
        usual: for differential equations.
    """
    is_map = plant.step is not None
    if integrator.steps_maps == is_map:
        return integrator
    return MapSteps() if is_map else usual
