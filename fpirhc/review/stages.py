"""Poles of one step of an integrator beside those of the plant, and the integrator that would follow it.

A step of length h follows a mode lambda where one of its poles is near exp(lambda h). An explicit step of a fast mode does not: its
pole is a polynomial of lambda h and may lie outside the unit circle although the mode decays.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.horizon.horizon import Horizon
from fpirhc.plant.integrators import Integrator
from fpirhc.plant.maps import poles_over
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.state_slopes import state_slopes

CLOSE = 0.05  # distance of a pole of the step from exp(pole of the plant x step)
_FINER = (2, 4, 8, 16, 32, 64)  # times the sub-steps in use


@dataclass(frozen=True)
class StepPoles:
    """Poles of one step beside those of the plant.

    Args:
        apart: largest distance of exp(lambda h) from the nearest pole of the step.
        fastest: largest |lambda|, per unit of time.
        largest: largest |pole| of the step.
        decays: whether no mode of the plant grows.
    """

    apart: float
    fastest: float
    largest: float
    decays: bool

    @property
    def unstable(self) -> bool:
        """Whether the step grows although the plant does not."""
        return self.decays and self.largest > 1 + CLOSE

    @property
    def follows(self) -> bool:
        """Whether the step follows every mode."""
        return not self.unstable and self.apart <= CLOSE


@dataclass(frozen=True, eq=False)
class Place:
    """A point at which a plant is linearised: state, input and parameters."""

    state: np.ndarray
    command: np.ndarray
    parameters: np.ndarray


def first_place(grid: ReviewGrid, parameters: np.ndarray) -> Place:
    """Return the start of the reference with these parameters."""
    return Place(grid.states[0], grid.needed(parameters)[0], parameters)


def step_poles(plant: Plant, integrator: Integrator, step: float, place: Place) -> StepPoles:
    """Return the poles of one step at a point.

    Raises:
        LinAlgError: the linearisation is not finite.
    """
    rates = np.linalg.eigvals(state_slopes(plant, place.state, place.command, place.parameters).a)
    poles = np.linalg.eigvals(_matrix(plant, integrator, step, place))
    exact = poles_over(plant, rates, step)
    apart = float(max(np.abs(poles - one).min() for one in exact))
    return StepPoles(
        apart, float(np.abs(rates).max()), float(np.abs(poles).max()), bool(np.abs(exact).max() <= 1 + 1e-9)
    )


HORIZON, CYCLE = "Horizon(discretisation={})", "Problem(integrator={})"


def advice(setting: str, plant: Plant, integrator: Integrator, step: float, place: Place) -> str:
    """Return, in a sentence, the integrator that follows the plant: explicit with few sub-steps, else implicit.

    `setting` is where it is set, such as `HORIZON`.
    """
    implicit = setting.format("RadauIIA()")
    for method in (integrator, Horizon(stages=1, step=step).discretisation):
        for times in _FINER:
            finer = method.finer(times)
            if finer is not None and step_poles(plant, finer, step, place).follows:
                return f"Use {setting.format(finer)}, which follows every mode, or {implicit} for modes that need not be followed."
    return f"Use {implicit}; no number of explicit sub-steps up to {_FINER[-1]} times that in use follows every mode."


def stiff_advice(grid: ReviewGrid, believed: np.ndarray, *, planned: bool) -> str:
    """Return what to change where a step of the horizon or of the simulated plant grows by itself; empty where none does."""
    problem, plant = grid.problem, grid.problem.plant
    try:
        place, horizon, cycle = first_place(grid, believed), problem.horizon, problem.integrator
        if (
            planned
            and horizon is not None
            and step_poles(plant, horizon.discretisation, horizon.longest, place).unstable
        ):
            cure = advice(HORIZON, plant, horizon.discretisation, horizon.longest, place)
            return f"Its discretisation grows. {cure}"
        if not cycle.opaque and step_poles(plant, cycle, problem.period, place).unstable:
            return f"The integrator of the plant grows. {advice(CYCLE, plant, cycle, problem.period, place)}"
    except (FpirhcError, np.linalg.LinAlgError):
        return ""
    return ""


def _matrix(plant: Plant, integrator: Integrator, step: float, place: Place) -> np.ndarray:
    """D x+ / d x of one step."""
    function = integrator.step(plant, step)
    x, u, p, w = (ca.SX.sym(function.name_in(k), function.size1_in(k)) for k in range(4))
    slope = ca.Function("fpirhc_step_matrix", [x, u, p, w], [ca.jacobian(function(x, u, p, w), x)])
    return np.asarray(slope(place.state, place.command, place.parameters, np.zeros(len(plant.names))).full())
