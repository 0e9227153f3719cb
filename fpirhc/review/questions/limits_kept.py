"""Does the reference keep the limits of the plan? Those of states, rates and paths; the inputs have a question of their own.

Inside its limits a plan is the feedback that the linear loops have: a limit that does not bind at rest has no effect on it. A limit
that the reference leaves, or touches, bends every plan there, and the linear answers do not cover this.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.plant.motion import controlled_places
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid, each
from fpirhc.review.question import ProblemQuestion

TEXT = "Does the reference keep the limits of states, rates and paths?"
_TOUCHES = 1e-6  # of the interval's size, within which a value is at its limit


def reference_keeps_limits(grid: ReviewGrid) -> Answer | None:
    """Return the limits that the reference leaves or touches; None without such limits or without a plan."""
    problem, limits = grid.problem, grid.problem.limits
    if problem.horizon is None or problem.cost is None or not (limits.states or limits.rates or limits.paths):
        return None
    horizon = replace(problem.horizon, terminal=())
    try:
        all_hard, start = replace(limits, soft={}, prices={}), problem.start_state
        ocp = transcribe(problem.plant, problem.reference, horizon, problem.cost, all_hard, start=start)
    except FpirhcError as error:
        return Answer(TEXT, Verdict.UNKNOWN, str(error))
    values = _values(grid, ocp)
    usable = np.isfinite(values).all(axis=1)
    if not usable.any():
        return Answer(TEXT, Verdict.UNKNOWN, "no finite command is known", "See whether the problem is well posed.")
    low, high = values[usable].min(axis=0), values[usable].max(axis=0)
    rooms = _rooms(ocp, low, high)
    bound = [k for k in range(len(rooms)) if np.isfinite(rooms[k])]
    name_of = dict(enumerate(zip(ocp.state.elements, ocp.state.units, strict=True)))
    text = "; ".join(
        f"{name_of[k][0]} from {low[k]:.3g} to {high[k]:.3g} {name_of[k][1]}, limits {ocp.state_lower[k]:.3g} and "
        f"{ocp.state_upper[k]:.3g}"
        for k in bound
    )
    numbers = {f"room_{name_of[k][0]}": float(rooms[k]) for k in bound}
    outside = [name_of[k][0] for k in bound if rooms[k] < -_TOUCHES]
    touched = [name_of[k][0] for k in bound if abs(rooms[k]) <= _TOUCHES]
    if not outside and not touched:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    change = f"Move the reference inside the limits of {', '.join([*outside, *touched])}, or widen them."
    softened = {*limits.soft, *limits.prices} | {f"{i} rate" for i in {*limits.soft, *limits.prices}}
    hard = [name for name in outside if name not in softened]
    return Answer(TEXT, Verdict.NO if hard else Verdict.UNKNOWN, text, change, numbers)


def _rooms(ocp: OptimalControl, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Distance to the nearest limit as a share of the interval, negative outside; infinite where nothing is limited."""
    with np.errstate(invalid="ignore"):
        interval = ocp.state_upper - ocp.state_lower
    scale = np.where(np.isfinite(interval) & (interval > 0), interval, np.maximum(np.maximum(abs(low), abs(high)), 1.0))
    return np.asarray(np.minimum(ocp.state_upper - high, low - ocp.state_lower) / scale)


def _values(grid: ReviewGrid, ocp: OptimalControl) -> np.ndarray:
    """The stage's state along the reference with the limited rates and paths as its last entries, shape (m, ns)."""
    problem, plant = grid.problem, grid.problem.plant
    assert problem.horizon is not None
    assert problem.cost is not None
    nx, nu = plant.state.size, plant.input.size
    data_of = stage_data(plant, problem.reference, replace(problem.horizon, terminal=()), problem.cost)
    data = np.array([np.asarray(data_of(t, plant.approximate).full())[:, 0] for t in grid.times])
    states = np.zeros((len(grid.times), ocp.state.size))
    states[:, :nx] = grid.states
    if ocp.state.size - ocp.written > nx:
        states[:, nx : nx + nu] = _commands_before(grid)
    written = each(ocp.dynamics, states, grid.commands[0], data)
    states[:, ocp.state.size - ocp.written :] = written[:, ocp.state.size - ocp.written :]
    return states


def _commands_before(grid: ReviewGrid) -> np.ndarray:
    """Inputs that the reference needs one stage earlier, shape (m, nu)."""
    problem, plant = grid.problem, grid.problem.plant
    assert problem.horizon is not None
    earlier = np.maximum(grid.times - problem.horizon.step, 0.0)
    responses = np.asarray(problem.reference.function(plant).map(len(earlier))(earlier[None, :])[1].full())
    exact = np.tile(plant.exact, (len(earlier), 1))
    return each(plant.equations.inverse, grid.states_at(earlier), responses[controlled_places(plant)].T, exact)


QUESTION = ProblemQuestion(ask=reference_keeps_limits, order=30)
