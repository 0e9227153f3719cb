"""Are the zero dynamics stable? They are the motion of the other states while the controlled ones stay on the reference.

With x' = A x + B u and the responses y^(r) = C x + D u of the controlled coordinates at zero, u = -D^-1 C x, the states that leave
the derivatives below them at zero move by themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg import null_space

from fpirhc.plant.maps import growth_of
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import Loops
from fpirhc.review.loops_by_gain import LITTLE
from fpirhc.review.state_slopes import StateSlopes, state_slopes
from fpirhc.simulation.linearise.linear_loop import NEUTRAL
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

QUESTION = "Are the zero dynamics stable?"
_BESIDE = 1.1  # the growth of the zero dynamics is that of the plant, and the nominal loop is that of the model
_STILL = 1e-4  # growth over the run, as a share, below which a mode is neutral


def zero_dynamics_rate(grid: ReviewGrid) -> float | None:
    """Return the largest real part of the zero dynamics along the reference, per unit of time; None where there are none.

    Of a map it is the largest rate with which one of its modes grows; minus infinity where all end within a few cycles.
    """
    plant = grid.problem.plant
    if sum(plant.response_orders.values()) == plant.state.size:
        return None
    modes = zero_dynamics_modes(grid, [k for k in range(len(grid.times)) if np.isfinite(grid.commands[0, k]).all()])
    growth = growth_of(plant)
    return max((float(growth(one).max()) for one in modes), default=float("nan"))


def of_zero_dynamics(grid: ReviewGrid, radius: float) -> bool:
    """Whether the loop grows no faster than the states that the controlled coordinates leave to themselves."""
    rate, period = zero_dynamics_rate(grid), grid.problem.period
    if rate is None or not rate > 0:
        return False
    grown = rate * period if grid.problem.plant.step is not None else math.expm1(rate * period)
    return radius - 1 <= _BESIDE * grown


def zero_dynamics_modes(grid: ReviewGrid, places: Sequence[int]) -> list[np.ndarray]:
    """Return the eigenvalues of the zero dynamics at points of the reference, per unit of time; none where all is controlled."""
    plant = grid.problem.plant
    return [_modes(state_slopes(plant, grid.states[k], grid.commands[0, k], plant.exact)) for k in places]


def _modes(slopes: StateSlopes) -> np.ndarray:
    """Eigenvalues of A - B D^-1 C on the states that leave all derivatives below the responses at zero, Y x = 0."""
    inside = null_space(slopes.y)
    motion = slopes.a - slopes.b @ np.linalg.solve(slopes.d, slopes.c)
    return np.asarray(np.linalg.eigvals(inside.T @ motion @ inside))


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
            held = text.replace("unstable: ", "unstable by themselves and held by the plan: ", 1)
            return Answer(QUESTION, Verdict.YES, held, "", numbers)
        little = radius < 1 + NEUTRAL or min(rate * problem.duration, radius**problem.cycles - 1) < LITTLE
        verdict = Verdict.UNKNOWN if loops.learns or neutral or little else Verdict.NO
        return Answer(QUESTION, verdict, text, "Weigh the other states in the cost, or lengthen the horizon.", numbers)
    if rate < 0 and not neutral:
        return Answer(QUESTION, Verdict.YES, text, "", numbers)
    if rate * problem.duration > LITTLE and not planned:
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
        return "the slowest of them neither grows nor decays"
    if rate > 0:
        grown = rate * problem.duration
        over = f", by {in_percent(grown)} over the run" if grown <= LITTLE else ""
        return f"unstable: while the reference is followed they grow at up to {rate:.3g} {unit}{over}"
    return f"stable: while the reference is followed they decay at {-rate:.3g} {unit} or faster"
