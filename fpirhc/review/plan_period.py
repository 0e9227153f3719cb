"""Linear loops of plans that are made every n cycles, over the whole period from plan to plan: in between nothing is fed back.

The loop itself is run along the reference and linearised (`fpirhc.simulation.linearise`). A loop that repeats itself after n cycles
has no transfer function of a cycle, so its margins are found by multiplying the command of one input: the smallest factor m, real
or on the unit circle, with which a pole of the whole period reaches the unit circle,

    det(zeta I - prod_k (F_k + (m - 1) G_k,i C_k,i)) = 0,    |zeta| = 1.

A mode turns by at most pi in a period, so the delay of a turned command follows from the turn of the mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError
from fpirhc.review.grid import ReviewGrid
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.linearise.linear_loop import LinearLoop
from fpirhc.task.problem import Problem, cycles_per_stage

_POINTS = 3  # of the reference
_CYCLES = 400  # of the run to a point, at most
_DECADES = math.log(1e3)  # of the gain margins that are looked for
_STEPS = 60
_SMALL = 1e-3  # feedback of a point at a limit, as a share of the others'


def plans_seldom(problem: Problem, controller: Controller) -> bool:
    """Whether plans that restart from the measured state are made less often than every cycle."""
    planner, horizon = controller.planner, problem.horizon
    if planner is None or horizon is None or not planner.restarts:
        return False
    return cycles_per_stage(horizon, problem.period) > 1


def loops_of_periods(grid: ReviewGrid, controller: Controller) -> tuple[LinearLoop, ...]:
    """Return the linear loops at some points of the reference where plans are inside the limits; none where there are none.

    A plan at a limit feeds nothing back. Of a controller that learns they are those before it has learned anything.
    """
    while controller.learns and controller.inner is not None:
        controller = controller.inner
    finite = [k for k in range(len(grid.times)) if np.isfinite(grid.commands[0, k]).all()]
    places = np.unique(np.linspace(0, len(finite) - 1, _POINTS).astype(int)) if finite else ()
    try:
        asked = AskedLoop(grid.problem, controller)
        loops = [_loop_at(asked, grid, finite[k]) for k in places]
    except (FpirhcError, np.linalg.LinAlgError):
        return ()
    fed_back = np.array([np.max([np.abs(c.arriving).max(axis=1) for c in one.cycles], axis=0) for one in loops])
    inside = (fed_back > _SMALL * fed_back.max(axis=0, initial=0.0)).all(axis=1) if loops else ()
    return tuple(one for one, counts in zip(loops, inside, strict=True) if counts)


def _loop_at(asked: AskedLoop, grid: ReviewGrid, place: int) -> LinearLoop:
    """The loop at a point at which what the controller remembers has found its place while the plant is led along the reference."""
    plant, period, state = grid.problem.plant, grid.problem.period, grid.states[place]
    start = asked.start(
        time=float(grid.times[place]),
        state=dict(zip(plant.state.elements, map(float, state), strict=True)),
        before=dict(zip(plant.inputs, map(float, grid.commands[0, place]), strict=True)),
        exact=grid.draws[0],
    )
    led = grid.states_at(grid.times[place] + period * np.arange(1, _CYCLES + 1))
    return asked.at(asked.quietest(asked.run(start, _CYCLES, led)))


def period_margins(loop: LinearLoop, place: int) -> tuple[float, float, float]:
    """Return the margins of one input: gain (a factor of at least 1, up or down), phase (degrees), delay (unit of time)."""
    up = _first(lambda x: _turned(loop, place, math.exp(x)), _DECADES)
    down = _first(lambda x: _turned(loop, place, math.exp(-x)), _DECADES)
    angle = _first(lambda x: _turned(loop, place, np.exp(-1j * x)), math.pi)
    poles = _turned(loop, place, np.exp(-1j * angle)) if math.isfinite(angle) else np.ones(1)
    turns = np.angle(poles[np.abs(np.abs(poles) - 1) < 1e-3])
    fastest = float(np.abs(turns).max(initial=0.0)) / (len(loop.cycles) * loop.period)
    return math.exp(min(up, down)), math.degrees(angle), angle / fastest if fastest else math.inf


def _turned(loop: LinearLoop, place: int, factor: complex) -> np.ndarray:
    """Poles of a period in which a command is multiplied by a factor."""
    whole: np.ndarray = np.eye(loop.dynamics.shape[1])
    for one in loop.cycles:
        more = (factor - 1) * np.outer(one.entry[:, place], one.arriving[place])
        whole = (one.dynamics + more) @ whole
    return np.asarray(np.linalg.eigvals(whole))


def _first(poles: Callable[[float], np.ndarray], most: float) -> float:
    """The smallest argument up to `most` where a pole leaves the unit circle; infinite where none does."""

    def outside(x: float) -> float:
        return float(np.abs(poles(x)).max()) - 1

    steps = np.linspace(0, most, _STEPS + 1)
    beyond = next((k for k, x in enumerate(steps) if k and outside(float(x)) >= 0), None)
    if beyond is None:
        return math.inf
    return float(brentq(outside, steps[beyond - 1], steps[beyond], rtol=1e-6))
