"""Are the zero dynamics stable? They are the motion of the other states while the controlled ones stay on the reference.

With x' = A x + B u and the responses y^(r) = A_c x + B_c u of the controlled coordinates at zero, u = -B_c^-1 A_c x, the states
that are no derivative of a controlled coordinate move by themselves.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.plant.plant import Plant
from fpirhc.review.answer import Answer, Verdict, decided
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.linear import response_slopes
from fpirhc.review.loops import Loops
from fpirhc.review.state_matrix import state_matrices

QUESTION = "Are the zero dynamics stable?"
_STILL = 1e-6  # 1/s


def zero_dynamics_rate(grid: ReviewGrid) -> float | None:
    """Return the largest real part of the zero dynamics along the reference, 1/s; None where there are none."""
    plant = grid.problem.plant
    inside = [k for k, e in enumerate(plant.state.elements) if e.rstrip("'") not in plant.controlled_names]
    if not inside:
        return None
    rates, slopes = [], response_slopes(plant)
    for state, command in zip(grid.states, grid.commands[0], strict=True):
        if np.isfinite(command).all():
            rates.append(_rate(plant, slopes(state, command, plant.exact), inside))
    return max(rates, default=float("nan"))


def _rate(plant: Plant, slopes: tuple[ca.DM, ca.DM], inside: list[int]) -> float:
    rows, gains = (np.asarray(m.full()) for m in slopes)
    controlled = list(plant.controlled_indices)
    a, b = state_matrices(plant, rows, gains)
    internal = (a - b @ np.linalg.solve(gains[controlled], rows[controlled]))[np.ix_(inside, inside)]
    return float(np.linalg.eigvals(internal).real.max())


def zero_dynamics(rate: float | None, planned: bool, loops: Loops) -> Answer:
    """Return whether the zero dynamics are stable.

    Args:
        rate: largest real part of the zero dynamics, 1/s; None where there are none.
        planned: whether the controller is a plan; with these states in its cost it may hold unstable ones.
        loops: linear loops of the controller.
    """
    if rate is None:
        return Answer(QUESTION, Verdict.YES, "there are none: every coordinate is controlled")
    numbers = {"rate": rate}
    text = f"their fastest growth is {rate:.3g} 1/s"
    if planned and loops.loops:
        radius = float(loops.radii.max())
        text += f"; with the plan's feedback the linear loop changes by {radius:.6g} per cycle"
        change = "" if radius < 1 else "Weigh the other states in the cost, or lengthen the horizon."
        verdict = Verdict.UNKNOWN if loops.learns and radius >= 1 else decided(radius < 1)
        return Answer(QUESTION, verdict, text, change, numbers)
    if not np.isfinite(rate) or planned or abs(rate) <= _STILL:
        change = "Undamped or not known: run it and look at the coordinates that are not controlled."
        return Answer(QUESTION, Verdict.UNKNOWN, text, change, numbers)
    change = (
        "" if rate < 0 else "Let a plan carry those states in its cost, use time slots, or control another coordinate."
    )
    return Answer(QUESTION, decided(rate < 0), text, change, numbers)
