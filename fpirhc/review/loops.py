"""The linear closed loop of a controller at points of the reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import Planner, without_deformation
from fpirhc.errors import FpirhcError, InvalidName, NotSupported
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.late import is_late, scaled
from fpirhc.review.linear import LinearLoop, controlled_gain, linear_parameters, loop_matrices
from fpirhc.review.plan_feedback import PlanGain, no_gain
from fpirhc.review.plan_of_outputs import gains_at
from fpirhc.review.stand_in import linear_stand_in
from fpirhc.review.straight import straightened

_WORK = 2e7  # entries^3 of all loops together: large ones are evaluated at fewer points
_FEWEST = 3
_DRAWN = 24  # draws of the parameters, of all points together


@dataclass(frozen=True, eq=False)
class Loops:
    """Linear loops of a controller along the reference, or the reason why there are none.

    Args:
        places: indices of the loops' points among the reference's points.
        loops: loops of the plant with its exact parameters, one for every place.
        ideal: loop of the controller without deformation whose model is the plant: the outer loop by itself.
        drawn: loops of plants from the box of parameters, and with the shortest and the longest dead time of the box.
        reason: why there are no loops; else empty.
        learns: whether the controller changes its model on line; then the loops are those of its first model.
    """

    places: tuple[int, ...]
    loops: tuple[LinearLoop, ...]
    ideal: LinearLoop | None
    drawn: tuple[LinearLoop, ...] = ()
    reason: str = ""
    learns: bool = False

    @property
    def radii(self) -> np.ndarray:
        """Largest |pole| at every point."""
        return np.array([one.radius for one in self.loops])


def loops_along(grid: ReviewGrid, controller: Controller) -> Loops:
    """Return the controller's linear loops along the reference, or the reason why there are none."""
    try:
        return replace(_loops(grid, controller), learns=controller.learns)
    except InvalidName as error:
        # The names of the plant's parameters mean nothing on a linearised plant, whose parameters are matrices.
        learned = f"{type(controller).__name__} learns parameters by name, which a linearised plant does not have"
        return Loops((), (), None, reason=learned if controller.learns else str(error), learns=controller.learns)
    except FpirhcError as error:
        return Loops((), (), None, reason=str(error), learns=controller.learns)
    except np.linalg.LinAlgError as error:
        return Loops((), (), None, reason=f"the linear loop has no eigenvalues: {error}")


def _loops(grid: ReviewGrid, controller: Controller) -> Loops:
    problem, plant = grid.problem, grid.problem.plant
    believed = controller.plant_model(problem).parameters(plant)
    stand_in, plan = linear_stand_in(problem, controller)
    matrices = loop_matrices(problem, stand_in)
    usable = [k for k in range(len(grid.times)) if np.isfinite(grid.commands[0, k]).all()]
    if not usable:
        raise NotSupported("the inverse does not exist along the reference")
    places = _thinned(usable, int(_WORK / max(len(matrices.rest), 1) ** 3))
    gains = dict(zip(places, plan_gains_at(grid, plan, [float(grid.times[k]) for k in places], believed), strict=True))

    straight = straightened(problem)

    def at(place: int, draw: int) -> LinearLoop:
        here = (grid.drawn_states[draw, place], grid.commands[draw, place])
        slopes = straight.slopes_on(here[0], grid.draws[draw])
        feedback = straight.feedback_on(gains[place], *here, grid.draws[draw], believed)
        own, model = (linear_parameters(slopes, *here, p, feedback) for p in (grid.draws[draw], believed))
        return matrices.at(own, model)

    first = (grid.states[places[0]], grid.commands[0, places[0]])
    feedback = straight.feedback_on(gains[places[0]], *first, believed, believed)
    model = linear_parameters(straight.slopes_on(first[0], believed), *first, believed, feedback)
    ideal = loop_matrices(problem, without_deformation(stand_in)).at(model, model)
    drawn = [at(k, d) for k, d in _pairs(grid, places) if np.isfinite(grid.commands[d, k]).all()]
    late = [loop for edge in _late(grid) for loop in loops_at(edge, controller, places[:: max(1, len(places) // 2)])]
    return Loops(tuple(places), tuple(at(k, 0) for k in places), ideal, (*drawn, *late))


def loops_at(grid: ReviewGrid, controller: Controller, places: Sequence[int]) -> list[LinearLoop]:
    """Return the controller's linear loops with the exact parameters at some points of the reference.

    Raises:
        NotSupported: no linear loop.
        FpirhcError: every error that the controller raises about a linear plant.
    """
    problem, plant = grid.problem, grid.problem.plant
    believed = controller.plant_model(problem).parameters(plant)
    stand_in, plan = linear_stand_in(problem, controller)
    feedbacks = plan_gains_at(grid, plan, [float(grid.times[k]) for k in places], believed)
    matrices, straight = loop_matrices(problem, stand_in), straightened(problem)
    loops = []
    for k, gain in zip(places, feedbacks, strict=True):
        here = (grid.states[k], grid.commands[0, k])
        slopes = straight.slopes_on(here[0], grid.draws[0])
        feedback = straight.feedback_on(gain, *here, grid.draws[0], believed)
        loops.append(matrices.at(*(linear_parameters(slopes, *here, p, feedback) for p in (grid.draws[0], believed))))
    return loops


def ideal_loops(grid: ReviewGrid, controller: Controller, count: int) -> list[tuple[LinearLoop, np.ndarray]]:
    """Return the loops of plant = model without deformation at `count` points of the reference.

    Returns:
        Pairs of a loop and the model's gain from inputs to responses of the controlled coordinates there, (n, nu).

    Raises:
        NotSupported: no linear loop, or no point where the model's inverse is finite.
        FpirhcError: every error that the controller raises.
    """
    problem, plant = grid.problem, grid.problem.plant
    believed = controller.plant_model(problem).parameters(plant)
    stand_in, plan = linear_stand_in(problem, controller)
    needed = grid.needed(believed)
    usable = [k for k in range(len(grid.times)) if np.isfinite(needed[k]).all()]
    if not usable:
        raise NotSupported("the model's inverse does not exist along the reference")
    places = _thinned(usable, count)
    feedbacks = plan_gains_at(grid, plan, [float(grid.times[k]) for k in places], believed)
    matrices = loop_matrices(problem, without_deformation(stand_in))
    straight = straightened(problem)
    loops = []
    for k, gain in zip(places, feedbacks, strict=True):
        slopes = straight.slopes_on(grid.states[k], believed)
        feedback = straight.feedback_on(gain, grid.states[k], needed[k], believed, believed)
        model = linear_parameters(slopes, grid.states[k], needed[k], believed, feedback)
        effect = controlled_gain(straight.plant, straight.slopes, grid.states[k], needed[k], believed)
        loops.append((matrices.at(model, model), effect))
    return loops


def _late(grid: ReviewGrid) -> list[ReviewGrid]:
    """The points with the shortest and the longest dead time of the box."""
    if not grid.mismatch or not is_late(grid.problem):
        return []
    return [replace(grid, problem=scaled(grid.problem, percent)) for percent in (-grid.mismatch, grid.mismatch)]


def _pairs(grid: ReviewGrid, places: list[int]) -> list[tuple[int, int]]:
    """Pairs of a point and a draw; every point has draws of its own, and few points have few draws."""
    count = min(len(grid.draws) - 1, _DRAWN, 2 * len(places))
    if count <= 0:
        return []
    draws = np.unique(np.linspace(1, len(grid.draws) - 1, count).astype(int))
    return [(places[i % len(places)], int(d)) for i, d in enumerate(draws)]


def _thinned(places: list[int], most: int) -> list[int]:
    count = min(len(places), max(_FEWEST, most))
    return [places[int(k)] for k in np.unique(np.linspace(0, len(places) - 1, count).astype(int))]


def plan_gains_at(grid: ReviewGrid, plan: Planner | None, times: list[float], believed: np.ndarray) -> list[PlanGain]:
    """Return the feedback of a plan at some times; no gain without a plan."""
    problem = grid.problem
    if plan is None:
        return [no_gain(problem.plant)] * len(times)
    cost = plan.cost or problem.cost
    assert problem.horizon is not None
    assert cost is not None
    consistent = plan.starts_consistent(problem.plant)
    return gains_at(problem, problem.horizon, cost, times, believed, grid.states_at, consistent=consistent)
