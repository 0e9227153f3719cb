"""Does the discretisation of the horizon follow the plant? Its poles are compared with those of the plant over one stage."""

from __future__ import annotations

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.stages import HORIZON, advice, first_place, step_poles

QUESTION = "Does the discretisation of the horizon follow the plant?"


def discretisation_follows(grid: ReviewGrid) -> Answer | None:
    """Return how far poles of a stage are from exp(lambda h) at the start of the reference; None without one or for a map."""
    return stage_follows(grid, grid.problem.plant.approximate, QUESTION)


def stage_follows(grid: ReviewGrid, believed: np.ndarray, question: str) -> Answer | None:
    """Return the same for a model with the believed parameters, shape (np,)."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.horizon is None or plant.step is not None:
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
