"""Do integrators follow the plant? Poles of a stage of the horizon, and of a cycle, are compared with those of the plant."""

from __future__ import annotations

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.plant.integrators import poles, stiffness
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import is_planned
from fpirhc.review.question import Case, ControllerQuestion, ProblemQuestion
from fpirhc.review.stages import CYCLE, HORIZON, Place, advice, first_place, step_poles
from fpirhc.review.true_plant_loop import real_points

DISCRETISATION = "Does the discretisation of the horizon follow the plant?"


def discretisation_follows(grid: ReviewGrid) -> Answer | None:
    """Return how far poles of a stage are from exp(lambda h) at the start of the reference; None without one or for a map."""
    return stage_follows(grid, grid.problem.plant.approximate, DISCRETISATION)


def stage_follows(grid: ReviewGrid, believed: np.ndarray, question: str) -> Answer | None:
    """Return the same for a model with the believed parameters, shape (np,)."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.horizon is None or problem.horizon.discretisation.steps_maps:
        return None
    h, discretisation = problem.horizon.longest, problem.horizon.discretisation
    place = first_place(grid, believed)
    try:
        poles = step_poles(plant, discretisation, h, place)
        change = "" if poles.follows else advice(HORIZON, plant, discretisation, h, place)
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(question, Verdict.UNKNOWN, f"the poles are not known: {error}")
    text = f"stage of {h:g} {problem.time_unit}, fastest mode {poles.fastest:.3g} {problem.rate_unit}"
    text += f"; poles of the stage are off by {poles.apart:.2g} at most"
    numbers = {"apart": poles.apart, "fastest_mode": poles.fastest, "largest_pole": poles.largest}
    if poles.unstable:
        text += f"; the plant's modes decay, but the discretisation grows by {poles.largest:.3g} per stage"
        return Answer(question, Verdict.NO, text, change, numbers)
    return Answer(question, Verdict.YES if poles.follows else Verdict.UNKNOWN, text, change, numbers)


OWN_MODEL = "Does the discretisation of the horizon follow the controller's own model?"


def own_model_stage(case: Case) -> Answer | None:
    """Return how far the poles of one stage are from those of the controller's model; None where it is the problem's model."""
    approximate = case.problem.plant.approximate
    if not is_planned(case.controller) or np.array_equal(case.believed, approximate):
        return None
    return stage_follows(case.grid, case.believed, OWN_MODEL)


PLANT = "Does the integrator follow the simulated plant?"
_POINTS = 5  # of the reference


def integrator_follows(grid: ReviewGrid) -> Answer | None:
    """Return how far poles of a cycle are from those of the plant; None for a map and for methods that control their error."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.integrator.opaque or problem.integrator.steps_maps:
        return None
    usable = [k for k in range(len(grid.times)) if np.isfinite(grid.commands[0, k]).all()]
    points = [usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, _POINTS).astype(int))] if usable else []
    places = [Place(grid.states[k], grid.commands[0, k], plant.exact) for k in points]
    try:
        poles = [step_poles(plant, problem.integrator, problem.period, place) for place in places]
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(PLANT, Verdict.UNKNOWN, f"the poles are not known: {error}")
    if not poles:
        return Answer(PLANT, Verdict.UNKNOWN, "the inverse does not exist along the reference")
    worst = max(range(len(poles)), key=lambda k: (poles[k].unstable, poles[k].apart))
    one = poles[worst]
    text = f"cycle of {problem.period:g} {problem.time_unit}, fastest mode {one.fastest:.3g} {problem.rate_unit}"
    text += f"; poles of the cycle are off by {one.apart:.2g} at most"
    numbers = {"apart": one.apart, "fastest_mode": one.fastest, "largest_pole": one.largest}
    if one.follows:
        return Answer(PLANT, Verdict.YES, text, "", numbers)
    change = advice(CYCLE, plant, problem.integrator, problem.period, places[worst])
    return Answer(PLANT, Verdict.NO if one.unstable else Verdict.UNKNOWN, text, change, numbers)


REALITY = "Does the integrator follow the reality along the reference?"


def reality_followed(grid: ReviewGrid) -> Answer | None:
    """Return whether a decaying mode of the reality grows where it settles on the reference; None without a reality."""
    problem = grid.real
    if problem is None:
        return None
    points = real_points(grid)
    if not points:
        return Answer(REALITY, Verdict.UNKNOWN, "the reality nowhere settles on the reference")
    plant, integrator = problem.real_plant, problem.real_integrator
    fastest_first = sorted(points, key=lambda one: -np.abs(poles(plant, one.real, one.command, plant.exact)).max())
    for point in fastest_first:
        stiff = stiffness(plant, integrator, problem.period, point.real, point.command, plant.exact)
        if stiff:
            what, _, remedy = stiff.partition("; use ")
            where = f"at t = {grid.times[point.place]:g} {problem.time_unit} "
            return Answer(REALITY, Verdict.NO, where + what, f"Use Reality({remedy}).")
    return Answer(REALITY, Verdict.YES, f"no decaying mode grows at {len(points)} points of the reference")


QUESTIONS = (
    ProblemQuestion(discretisation_follows, DISCRETISATION, order=5),
    ProblemQuestion(integrator_follows, PLANT, order=20),
    ProblemQuestion(reality_followed, REALITY, order=21),
    ControllerQuestion(own_model_stage, OWN_MODEL, order=50, adaptive=False),
)
