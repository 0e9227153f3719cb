"""Inner states: coordinates that have no task. They are neither controlled nor judged, and no cost weighs them.

What a reference gives for them is an invention. A review linearises on the motion that they have while the other states are on the
reference, with the inputs that this needs,

    z' = f(x^N, z, inverse(x^N, z, r^N; p); p),        z(0) = the problem's start.

Where this motion runs away and the reference is held, it is the rest there: a plant behind lags is held by no inverse.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.horizon.nominal import output_feedback
from fpirhc.horizon.transcription import transcribe
from fpirhc.plant.chain import nominal_responses
from fpirhc.symbolic.evaluate import require_unsolved
from fpirhc.symbolic.expression import kind
from fpirhc.symbolic.layout import Expression
from fpirhc.symbolic.roots import Equations
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem

_TOLERANCE = 1e-7
_STEPS = 100_000
_DECAYS = 20.0  # times in a run, by which the error of outputs at the start decays
_FASTEST = 0.1  # of the cycle, the rate of this decay
_SHORTEST = 2000  # steps of a run at least
_AWAY = 1e9  # of the start, from which a motion runs away
_ROUNDING = 1e-9
_WHOLE = 1e-6  # share of a cycle by which a time may be rounded


def inner_places(problem: Problem) -> tuple[int, ...]:
    """Return the places of the inner states among the states of the plant."""
    plant = problem.plant
    if plant.outputs:
        return tuple(range(plant.state.size))  # all are simulated, while the outputs follow their reference
    with_task = {*plant.controlled_names, *problem.judged_names}
    weighed = _weighed(problem)
    with_task |= {plant.state.elements[k].rstrip("'") for k in weighed}
    return tuple(k for k, e in enumerate(plant.state.elements) if e.rstrip("'") not in with_task)


def inner_motion(
    problem: Problem, places: Sequence[int], draws: np.ndarray, times: np.ndarray
) -> list[np.ndarray | None]:
    """Return the motion of the inner states for every draw of the exact parameters.

    Args:
        problem: the problem.
        places: of the inner states, from `inner_places`.
        draws: parameters, shape (draws, np).
        times: increasing times from 0 on, shape (m,).

    Returns:
        For every draw the states, shape (m, len(places)); None where they do not stay finite, and there is no rest.
    """
    moved = _moved(problem, places, draws, times)
    away = [one is None or bool(np.abs(one).max() > _AWAY * max(1.0, np.abs(one[0]).max())) for one in moved]
    if not problem.plant.outputs or not any(away) or not _held(problem, times):
        return moved
    every = zip(moved, away, draws, strict=True)
    return [_at_rest(problem, places, row, len(times)) if gone else one for one, gone, row in every]


def _moved(problem: Problem, places: Sequence[int], draws: np.ndarray, times: np.ndarray) -> list[np.ndarray | None]:
    start = problem.start_state[list(places)]
    if problem.plant.step is not None:
        step = _cycle(problem, list(places))
        return [_motion_of_map(step, problem.period, start, row, times) for row in draws]
    steps = _integrator(problem, list(places), times)
    return [_motion(steps, start, row) for row in draws]


def _motion_of_map(
    step: ca.Function, period: float, start: np.ndarray, parameters: np.ndarray, times: np.ndarray
) -> np.ndarray | None:
    """States of the cycle in which every time lies."""
    cycles = np.floor(times / period + _WHOLE).astype(int)
    count = max(int(cycles[-1]), 1)
    starts, held = period * np.arange(count), np.repeat(parameters[:, None], count, axis=1)
    later = np.asarray(step.mapaccum("fpirhc_inner", count)(start, starts[None, :], held).full()).T
    rows = np.vstack([start, later])[cycles]
    return rows if np.isfinite(rows).all() else None


def _motion(steps: ca.Function, start: np.ndarray, parameters: np.ndarray) -> np.ndarray | None:
    try:
        rows = np.asarray(steps(x0=start, p=parameters)["xf"].full()).T
    except RuntimeError as error:  # CVODES gives up where the motion leaves every bound
        require_unsolved(error)
        return None
    return np.vstack([start, rows]) if np.isfinite(rows).all() else None


def _held(problem: Problem, times: np.ndarray) -> bool:
    """Whether the reference does not move."""
    outputs = np.asarray(problem.reference.function(problem.plant).map(len(times))(times[None, :])[0].full())
    return bool((np.ptp(outputs, axis=1) <= _ROUNDING * np.abs(outputs).max(axis=1)).all())


def _at_rest(problem: Problem, places: Sequence[int], parameters: np.ndarray, count: int) -> np.ndarray | None:
    rest = _rest(problem, parameters)
    return None if rest is None else np.tile(rest[list(places)], (count, 1))


def _rest(problem: Problem, parameters: np.ndarray) -> np.ndarray | None:
    """The state in which the controlled outputs are on the reference and nothing moves, shape (nx,); None where none is found.

    The search begins at the start of the problem.
    """
    plant = problem.plant
    x, u, p = plant.symbols()
    calm = np.zeros(len(plant.names))
    drift = plant.equations.forced_rate(x, u, p, calm)  # of a map its differences
    wanted = np.asarray(problem.reference.function(plant)(0.0)[0].full()).ravel()
    places = [plant.output.elements.index(name) for name in plant.controlled_names]
    off = plant.equations.output(x, u, p, calm)[places] - wanted[places]
    root = Equations(ca.vertcat(x, u), [p], ca.vertcat(drift, off)).root(
        np.concatenate([problem.start_state, problem.inputs_before]), parameters
    )
    return None if root is None else root.at[: plant.state.size]


def _cycle(problem: Problem, places: list[int]) -> ca.Function:
    """Function (inner states, time, parameters) -> inner states of a map one cycle later."""
    plant = problem.plant
    t, p, inner, state, command = _on_reference(problem, places)
    after = plant.equations.next(state, command, p, np.zeros(len(plant.names)))[places]
    return ca.Function("fpirhc_inner_cycle", [inner, t, p], [ca.densify(after)])


def _integrator(problem: Problem, places: list[int], times: np.ndarray) -> ca.Function:
    plant = problem.plant
    t, p, inner, state, command = _on_reference(problem, places)
    rate = plant.equations.forced_rate(state, command, p, np.zeros(len(plant.names)))[places]
    # Friction at a reversal is at rest until it is not: a step must not pass over the whole reversal.
    longest = max(problem.period, problem.duration / _SHORTEST)
    options = {
        "reltol": _TOLERANCE,
        "abstol": _TOLERANCE * 1e-3,
        "max_num_steps": _STEPS,
        "max_step_size": longest,
        "disable_internal_warnings": True,
        "show_eval_warnings": False,
    }
    system = {"x": inner, "p": p, "t": t, "ode": rate}
    return ca.integrator("fpirhc_inner", "cvodes", system, float(times[0]), [float(v) for v in times[1:]], options)


def _on_reference(problem: Problem, places: list[int]) -> tuple[Expression, ...]:
    """Symbols of time, parameters and inner states, and the state and the command while the others are on the reference."""
    plant = problem.plant
    matrix = kind(problem.reference.opaque or plant.equations.inverse_opaque)
    t, p, inner = matrix.sym("t"), matrix.sym("p", plant.parameter.size), matrix.sym("z", len(places))
    nominal, response = problem.reference.function(plant)(t)
    rows = [nominal[place] if place >= 0 else inner[0] for place in plant.equations.known_by_outputs]
    for place, entry in zip(places, range(len(places)), strict=True):
        rows[place] = inner[entry]
    state = ca.vertcat(*rows)
    wanted = nominal_responses(plant, nominal, response)
    decay = min(_DECAYS / problem.duration, _FASTEST / problem.period)
    wanted = wanted + output_feedback(plant, state, nominal, p, decay)  # of states on the reference there is no error
    return t, p, inner, state, plant.equations.inverse(state, wanted, p)


def _weighed(problem: Problem) -> set[int]:
    """Places of the states on which the cost of a stage depends."""
    if problem.horizon is None or problem.cost is None:
        return set()
    try:
        stage = transcribe(problem.plant, problem.reference, problem.horizon, problem.cost, Limits()).stage_cost
    except FpirhcError:
        return set(range(problem.plant.state.size))
    pattern = np.asarray(ca.DM(stage.jac_sparsity(0, 0), 1).full())
    return {k for k in range(problem.plant.state.size) if pattern[0, k]}
