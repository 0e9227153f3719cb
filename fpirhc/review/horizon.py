"""Is the horizon long enough? It is, where a horizon of twice the length hardly changes the first command of a plan."""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg

from fpirhc.errors import FpirhcError
from fpirhc.plant.maps import growth_of
from fpirhc.plant.motion import sampling
from fpirhc.plant.plant import Plant
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.plan_feedback import PlanGain, longer
from fpirhc.review.plan_of_outputs import gains_at
from fpirhc.review.stages import stiff_advice
from fpirhc.review.state_slopes import state_slopes
from fpirhc.summary import in_percent

QUESTION = "Is the horizon long enough?"
_SAME = 0.1  # relative change of the plan's feedback
_LITTLE = 0.1  # growth over the run, as a share, that the run does not show
_STILL = 1e-6  # of a growth per stage: a mode that neither decays nor grows


def horizon_long_enough(grid: ReviewGrid) -> Answer | None:
    """Return how the plan's feedback at the start of the reference changes with the horizon; None without one."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.horizon is None or problem.cost is None:
        return None
    reach, unit = float(problem.horizon.nodes[-1]), problem.time_unit
    try:
        [first] = gains_at(problem, problem.horizon, problem.cost, [0.0], plant.approximate, grid.states_at)
        [second] = gains_at(problem, longer(problem.horizon), problem.cost, [0.0], plant.approximate, grid.states_at)
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(QUESTION, Verdict.UNKNOWN, f"{reach:g} {unit}; the plan's feedback is not known: {error}")
    size = float(np.linalg.norm(second.entries))
    change = float(np.linalg.norm(first.entries - second.entries)) / max(size, 1e-300)
    grows = _growth(grid, first)
    slowest = _slowest(grid)
    text = (
        f"{reach:g} {unit}; twice as long changes the plan's feedback by {in_percent(change)}; slowest time constant "
    )
    text += f"{slowest:.3g} {unit}" if math.isfinite(slowest) else "infinite"
    numbers = {"reach": reach, "change": change, "slowest_time_constant": slowest, "growth": grows}
    if grows > 0:
        text += f"; the model under the plan's feedback diverges at {grows:.3g} {problem.rate_unit}"
        stiff = stiff_advice(grid, plant.approximate, planned=True)
        verdict = Verdict.UNKNOWN if grows * problem.duration <= _LITTLE else Verdict.NO
        return Answer(QUESTION, verdict, text, stiff or _advice(plant, change), numbers)
    if change > _SAME:
        return Answer(
            QUESTION, Verdict.UNKNOWN, text, "A longer horizon, or a weight of its end, plans differently.", numbers
        )
    return Answer(QUESTION, Verdict.YES, text, "", numbers)


def _advice(plant: Plant, change: float) -> str:
    """What to change where the model diverges under the plan's feedback."""
    if change <= _SAME:
        return "A longer horizon plans the same: weigh what diverges, see the zero dynamics."
    return f"Lengthen the horizon, or weigh its end{'' if plant.outputs else ' (LQRTerminal)'}."


def _slowest(grid: ReviewGrid) -> float:
    """Longest time constant of the model alone; infinite where a mode neither decays nor grows."""
    rates = np.abs(growth_of(grid.problem.plant)(np.linalg.eigvals(_model(grid)[0])))
    return float(1 / rates.min()) if rates.min() > 1e-9 else float("inf")


def _growth(grid: ReviewGrid, gain: PlanGain) -> float:
    """Growth rate of the model's fastest mode, per unit of time, where every stage begins with a new plan.

    It is ln(rho) / step with the spectral radius rho of the state and the held input over one stage, and 0 where rho is 1.
    """
    assert grid.problem.horizon is not None
    step = grid.problem.horizon.step
    a, b = _model(grid)
    nx, nu = b.shape
    rates = np.block([[a, b], [np.zeros((nu, nx + nu))]])
    held = _transition(grid.problem.plant, rates, step)[:nx]
    feedback = np.hstack([gain.state, gain.before])
    stage = np.vstack([held[:, :nx] @ np.eye(nx, nx + nu) + held[:, nx:] @ feedback, feedback])
    radius = float(np.abs(np.linalg.eigvals(stage)).max())
    return 0.0 if abs(radius - 1) < _STILL else math.log(radius) / step


def _transition(plant: Plant, rates: np.ndarray, time: float) -> np.ndarray:
    """The matrix by which x' = rates x moves in that time; of a map (1 + T rates)^n in n cycles."""
    if plant.step is None:
        return np.asarray(scipy.linalg.expm(time * rates))
    return np.linalg.matrix_power(np.eye(len(rates)) + sampling(plant) * rates, round(time / sampling(plant)))


def _model(grid: ReviewGrid) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the model's state at the start of the reference."""
    plant = grid.problem.plant
    needed = grid.needed(plant.approximate)[0]
    slopes = state_slopes(plant, grid.states[0], needed, plant.approximate)
    return slopes.a, slopes.b
