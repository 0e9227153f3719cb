"""Does the discretisation of the horizon follow the plant? Its poles are compared with those of the plant over one stage."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.linear import response_slopes
from fpirhc.review.state_matrix import state_matrices

QUESTION = "Does the discretisation of the horizon follow the plant?"
_CLOSE = 0.05  # distance of a pole of the stage from exp(pole of the model x step)


def discretisation_follows(grid: ReviewGrid) -> Answer | None:
    """Return how far the poles of one stage are from exp(lambda h) at the start of the reference; None without a horizon."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.horizon is None:
        return None
    h, state, needed = problem.horizon.step, grid.states[0], grid.needed(plant.approximate)[0]
    try:
        slopes = response_slopes(plant)(state, needed, plant.approximate)
        rates = np.linalg.eigvals(state_matrices(plant, *(np.asarray(m.full()) for m in slopes))[0])
        poles = np.linalg.eigvals(_stage_matrix(grid, state, needed))
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(QUESTION, Verdict.UNKNOWN, f"the poles are not known: {error}")
    exact = np.exp(rates * h)
    apart = float(max(np.abs(poles - one).min() for one in exact))
    fastest = float(np.abs(rates).max())
    text = f"stage of {h:g} {problem.time_unit}, fastest mode {fastest:.3g} {problem.rate_unit}"
    text += f"; poles of the stage are off by {apart:.2g} at most"
    numbers = {"apart": apart, "fastest_mode": fastest, "largest_pole": float(np.abs(poles).max())}
    if np.abs(poles).max() > 1 + _CLOSE and np.abs(exact).max() <= 1:
        text += f"; the plant's modes decay, but the discretisation grows by {np.abs(poles).max():.3g} per stage"
        return Answer(
            QUESTION, Verdict.NO, text, "Use sub-steps, or RadauIIA() for modes that need not be followed.", numbers
        )
    if apart > _CLOSE:
        return Answer(
            QUESTION, Verdict.UNKNOWN, text, "More sub-steps, or an implicit integrator, follow it better.", numbers
        )
    return Answer(QUESTION, Verdict.YES, text, "", numbers)


def _stage_matrix(grid: ReviewGrid, state: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """D x+ / d x of one stage."""
    problem, plant = grid.problem, grid.problem.plant
    assert problem.horizon is not None
    step = problem.horizon.discretisation.step(plant, problem.horizon.step)
    x, u, p, w = (ca.SX.sym(step.name_in(k), step.size1_in(k)) for k in range(4))
    moved = ca.Function("fpirhc_stage_matrix", [x, u, p, w], [ca.jacobian(step(x, u, p, w), x)])
    return np.asarray(moved(state, needed, plant.approximate, np.zeros(len(plant.names))).full())
