"""Is the horizon long enough? It is, where a horizon of twice the length hardly changes the first command of a plan."""

from __future__ import annotations

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.linear import response_slopes
from fpirhc.review.plan_feedback import longer, plan_gains
from fpirhc.review.state_matrix import state_matrices

QUESTION = "Is the horizon long enough?"
_SAME = 0.1  # relative change of the plan's feedback


def horizon_long_enough(grid: ReviewGrid) -> Answer | None:
    """Return how the plan's feedback at the start of the reference changes with the horizon; None without one."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.horizon is None or problem.cost is None:
        return None
    reach = problem.horizon.stages * problem.horizon.step
    try:
        [first] = plan_gains(problem, problem.horizon, problem.cost, [0.0], plant.approximate)
        [second] = plan_gains(problem, longer(problem.horizon), problem.cost, [0.0], plant.approximate)
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(QUESTION, Verdict.UNKNOWN, f"{reach:g} s; the plan's feedback is not known: {error}")
    change = float(np.linalg.norm(first - second)) / max(float(np.linalg.norm(second)), 1e-300)
    grows = _fastest(grid, first)
    slowest = _slowest(grid)
    text = f"{reach:g} s; twice as long changes the plan's feedback by {100 * change:.3g} %; slowest time constant {slowest:.3g} s"
    numbers = {"reach": reach, "change": change, "slowest_time_constant": slowest, "growth": grows}
    if grows > 0:
        text += f"; the model under the plan's feedback diverges at {grows:.3g} 1/s"
        return Answer(QUESTION, Verdict.NO, text, "Lengthen the horizon, or weigh its end (LQRTerminal).", numbers)
    if change > _SAME:
        return Answer(
            QUESTION, Verdict.UNKNOWN, text, "A longer horizon, or a weight of its end, plans differently.", numbers
        )
    return Answer(QUESTION, Verdict.YES, text, "", numbers)


def _slowest(grid: ReviewGrid) -> float:
    """Longest time constant of the model alone, s; infinite where a mode neither decays nor grows."""
    plant = grid.problem.plant
    without_feedback = _generator(grid, np.zeros((len(plant.inputs), plant.state.size)))
    rates = np.abs(np.linalg.eigvals(without_feedback).real)
    return float(1 / rates.min()) if rates.min() > 1e-9 else float("inf")


def _fastest(grid: ReviewGrid, gain: np.ndarray) -> float:
    """Largest real part of the model's poles under the feedback, 1/s."""
    return float(np.linalg.eigvals(_generator(grid, gain)).real.max())


def _generator(grid: ReviewGrid, gain: np.ndarray) -> np.ndarray:
    """A + B K of the model's state at the start of the reference."""
    plant = grid.problem.plant
    needed = grid.needed(plant.approximate)[0]
    slopes = response_slopes(plant)(grid.states[0], needed, plant.approximate)
    a, b = state_matrices(plant, *(np.asarray(m.full()) for m in slopes))
    return a + b @ gain
