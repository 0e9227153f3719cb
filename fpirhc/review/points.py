"""What a review looks at beside runs: the reference, slopes of the plant where a run goes, and plants of the box."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.controllers.reference_states import nominal_motion
from fpirhc.horizon.nominal import filled
from fpirhc.plant.plant import Plant, exact_ranges
from fpirhc.simulation.run import Run
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.problem import Problem

_TURNS = {"rad": 2 * np.pi, "deg": 360.0, "°": 360.0}  # a whole turn by unit
_NEAR = 0.05  # share of a turn that a jump of whole turns may be off, because the reference moves within a cycle
_OWN = 0.25  # share of a turn per cycle, up to which an angle moves by itself


def reference(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return nominal outputs (cycles, ny) and responses (cycles, n) at the beginning of every cycle."""
    times = problem.period * np.arange(problem.cycles)
    outputs, responses = nominal_motion(problem).map(problem.cycles)(times[None, :])
    return np.asarray(outputs.full()).T, np.asarray(responses.full()).T


def whole_turns(problem: Problem) -> tuple[str, int] | None:
    """Return the angle whose reference jumps by whole turns most often, and how often; None: no angle is controlled."""
    outputs, found = reference(problem)[0], list[tuple[str, int]]()
    for name in problem.plant.controlled_names:
        signal, place = problem.plant.output, problem.plant.output.elements.index(name)
        turn = _TURNS.get(signal.entry_units[place])
        if turn is not None:
            turns = np.diff(outputs[:, place]) / turn
            jumps = (np.abs(turns) > _OWN) & (np.abs(turns - np.round(turns)) < _NEAR)
            found.append((name, int(jumps.sum())))
    return max(found, key=lambda one: one[1], default=None)


def needed_commands(problem: Problem, run: Run) -> np.ndarray:
    """Return the inputs that the model needs along the reference, shape (cycles, nu); what has none is where the run has it."""
    plant, count = problem.plant, min(problem.cycles, run.cycles)
    outputs, responses = (rows[:count] for rows in reference(problem))
    states = filled(plant, outputs)
    if run["plant_state"].shape[1] == plant.state.size:
        states = np.where(np.isfinite(states), states, run["plant_state"][:count])
    return each(plant.equations.inverse, states, responses, np.tile(plant.approximate, (count, 1)))


class StateSlopes(NamedTuple):
    """A (nx, nx), B (nx, nu), C (n, nx), D (n, nu), Y (sum of relative orders, nx), of the controlled coordinates or outputs."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    y: np.ndarray


def state_slopes(plant: Plant, state: np.ndarray, command: np.ndarray, parameters: np.ndarray) -> StateSlopes:
    """Return the slopes at a point; those of a map are of its divided differences."""
    return StateSlopes(*(np.asarray(m.full()) for m in _slopes(plant)(state, command, parameters)))


@lru_cache(maxsize=8)  # several questions of a review need it
def _slopes(plant: Plant) -> ca.Function:
    x, u, p = plant.symbols()
    rates, responses = plant.equations.rate(x, u, p), plant.equations.controlled_response(x, u, p)
    shown, orders = plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names))), plant.response_orders
    below = [k for k, e in enumerate(plant.output.elements) if orders.get(e.rstrip("'"), 0)]  # none of order 0
    chain = ca.vertcat(ca.SX(0, 1), *(shown[k] for k in below))
    pairs = ((rates, x), (rates, u), (responses, x), (responses, u), (chain, x))
    return ca.Function("fpirhc_state_slopes", [x, u, p], [ca.densify(ca.jacobian(one, by)) for one, by in pairs])


def zero_dynamics(s: StateSlopes) -> float:
    """Return the largest real part of the rates at which states move while the outputs are held."""
    free = np.linalg.svd(s.y)[2][np.linalg.matrix_rank(s.y) :].T if len(s.y) else np.eye(len(s.a))
    return float(np.linalg.eigvals(free.T @ (s.a - s.b @ np.linalg.pinv(s.d) @ s.c) @ free).real.max())


def box(plant: Plant, mismatch: float, seed: int) -> np.ndarray:
    """Return exact parameters by rows: opposite corners of the range, or without one the middle and the model."""
    ranges = exact_ranges(plant, mismatch)
    low, high = (np.array([ranges[name][k] for name in plant.parameters]) for k in (0, 1))
    if np.array_equal(low, high):
        away = plant.approximate - low
        return low + np.array([[0.5], [1.0]]) * away if away.any() else np.zeros((0, low.size))
    half = np.random.default_rng(seed).integers(0, 2, size=(2, low.size))
    return low + np.vstack([half, 1 - half]) * (high - low)


def each(function: ca.Function, *arguments: np.ndarray) -> np.ndarray:
    """Return the values of a Function of columns at every row of its arguments, shape (rows, size)."""
    count = len(arguments[0])
    [table] = Evaluator(function.map(count))(*arguments)
    return table.reshape(count, -1)
