"""Are the zero dynamics stable? They are the motion of the other states while the controlled ones stay on the reference.

With x' = A x + B u and the responses y^(r) = A_c x + B_c u of the controlled coordinates at zero, u = -B_c^-1 A_c x, the states
that are no derivative of a controlled coordinate move by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.plant.maps import growth_of
from fpirhc.plant.plant import Plant
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import Loops
from fpirhc.review.neutral import NEUTRAL
from fpirhc.review.state_matrix import state_matrices
from fpirhc.review.straight import straightened
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

QUESTION = "Are the zero dynamics stable?"
_STILL = 1e-4  # growth over the run, as a share, below which a mode is neutral
_LITTLE = 0.1  # below which the run does not show it


def zero_dynamics_rate(grid: ReviewGrid) -> float | None:
    """Return the largest real part of the zero dynamics along the reference, per unit of time; None where there are none.

    Of a map it is the largest rate with which one of its modes grows; minus infinity where all end within a few cycles.
    """
    if not _inside(straightened(grid.problem).plant):
        return None
    modes = zero_dynamics_modes(grid, [k for k in range(len(grid.times)) if np.isfinite(grid.commands[0, k]).all()])
    growth = growth_of(grid.problem.plant)
    return max((float(growth(one).max()) for one in modes), default=float("nan"))


def zero_dynamics_modes(grid: ReviewGrid, places: Sequence[int]) -> list[np.ndarray]:
    """Return the eigenvalues of the zero dynamics at points of the reference, per unit of time; none where all is controlled."""
    straight = straightened(grid.problem)
    plant, exact, inside = straight.plant, grid.problem.plant.exact, _inside(straight.plant)
    if not inside:
        return [np.zeros(0)] * len(places)
    points = [(grid.states[k], grid.commands[0, k]) for k in places]
    return [_modes(plant, straight.slopes_on(x, exact)(x, u, exact), inside) for x, u in points]


def _inside(plant: Plant) -> list[int]:
    """Places of the states that are no derivative of a controlled coordinate."""
    return [k for k, e in enumerate(plant.state.elements) if e.rstrip("'") not in plant.controlled_names]


def _modes(plant: Plant, slopes: tuple[ca.DM, ca.DM], inside: list[int]) -> np.ndarray:
    rows, gains = (np.asarray(m.full()) for m in slopes)
    controlled = list(plant.controlled_indices)
    a, b = state_matrices(plant, rows, gains)
    internal = (a - b @ np.linalg.solve(gains[controlled], rows[controlled]))[np.ix_(inside, inside)]
    return np.asarray(np.linalg.eigvals(internal))


def zero_dynamics(problem: Problem, rate: float | None, planned: bool, loops: Loops) -> Answer:
    """Return whether the zero dynamics are stable, with their rate and its sign.

    Args:
        problem: the problem.
        rate: largest real part of the zero dynamics, per unit of time; None where there are none.
        planned: whether the controller is a plan; with these states in its cost it may hold unstable ones.
        loops: linear loops of the controller.
    """
    if rate is None:
        return Answer(QUESTION, Verdict.YES, "there are none: every coordinate is controlled")
    numbers, text = {"rate": rate}, _text(problem, rate)
    neutral = abs(rate) * problem.duration <= _STILL
    if ((planned and rate > 0) or neutral) and loops.loops:
        radius = float(loops.radii.max())
        numbers["radius"] = radius
        text += f"; the slowest mode of the linear loop is multiplied by {radius:.6g} per cycle"
        if radius < 1:
            return Answer(QUESTION, Verdict.YES, text, "", numbers)
        little = radius < 1 + NEUTRAL or radius**problem.cycles < 1 + _LITTLE
        verdict = Verdict.UNKNOWN if loops.learns or neutral or little else Verdict.NO
        return Answer(QUESTION, verdict, text, "Weigh the other states in the cost, or lengthen the horizon.", numbers)
    if rate < 0 and not neutral:
        return Answer(QUESTION, Verdict.YES, text, "", numbers)
    if rate * problem.duration > _LITTLE and not planned:
        change = "Let a plan carry those states in its cost, use time slots, or control another coordinate."
        return Answer(QUESTION, Verdict.NO, text, change, numbers)
    change = "Run it and look at the coordinates that are not controlled."
    if planned and rate > 0 and not neutral:
        change = f"A plan holds them only if its cost weighs those states. {change}"
    return Answer(QUESTION, Verdict.UNKNOWN, text, change, numbers)


def _text(problem: Problem, rate: float) -> str:
    unit = problem.rate_unit
    if rate == -np.inf:
        return "stable: while the reference is followed they end within as many cycles as they have states"
    if not np.isfinite(rate):
        return "their rate is not known: the reference has no finite command"
    if abs(rate) * problem.duration <= _STILL:
        return "they neither grow nor decay"
    if rate > 0:
        grown = rate * problem.duration
        over = f", by {in_percent(grown)} over the run" if grown <= _LITTLE else ""
        return f"unstable: while the reference is followed they grow at up to {rate:.3g} {unit}{over}"
    return f"stable: while the reference is followed they decay at {-rate:.3g} {unit} or faster"
