"""The points of a review: points of the reference, draws of the exact parameters, dead times, and slopes of the plant there.

Inner states have no task: they are neither controlled nor judged, and no cost weighs them. What a reference gives for them is an
invention, so they are simulated while the others are on the reference, z' = f(x^N, z, inverse(x^N, z, r^N; p); p). Where this
motion runs away and the reference is held, it is the rest there. Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.controllers.reference_states import nominal_motion
from fpirhc.errors import FpirhcError
from fpirhc.horizon.nominal import filled, output_feedback
from fpirhc.horizon.transcription import transcribe
from fpirhc.plant.chain import nominal_responses
from fpirhc.plant.plant import Plant, exact_ranges
from fpirhc.symbolic.evaluate import Evaluator, Latest, require_unsolved
from fpirhc.symbolic.expression import kind
from fpirhc.symbolic.layout import Expression
from fpirhc.task.dead_time import MEASUREMENT
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
    if problem.integrator.steps_maps:
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
    moved, left = ca.vertcat(x, u), ca.vertcat(drift, off)
    values = ca.Function("fpirhc_rest", [moved, p], [ca.densify(left), ca.densify(ca.jacobian(left, moved))])
    at = np.concatenate([problem.start_state, problem.inputs_before])
    for _ in range(_NEWTON):
        residual, slope = (np.asarray(m.full()) for m in values(at, parameters))
        if not (np.isfinite(residual).all() and np.isfinite(slope).all()):
            return None
        sizes = np.abs(slope).max(axis=1, initial=0.0)  # rows differ by powers of the fastest rate
        sizes[sizes == 0] = 1.0
        # The shortest of the steps that solve the linear equations best: where many points are at rest, to a near one.
        step = np.linalg.lstsq(slope / sizes[:, None], -residual.ravel() / sizes, rcond=None)[0]
        at += step
        if np.abs(step).max(initial=0.0) <= _SMALL * (1 + np.abs(at).max(initial=0.0)):
            return at[: plant.state.size]
    return None


_NEWTON, _SMALL = 60, 1e-10  # steps, and the last one, relative


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


_WHOLE_CYCLE = 1e-9  # of a cycle


def scaled(problem: Problem, percent: float) -> Problem:
    """Return the problem with all dead times longer by so many percent, rounded away from the true one to whole cycles.

    A fraction of a cycle is interpolated between two commands, which damps requests that alternate. The shortest one is none.
    """
    rounded: Callable[[float], int] = math.ceil if percent > 0 else math.floor
    sign = _WHOLE_CYCLE if percent > 0 else -_WHOLE_CYCLE

    def changed(time: float) -> float:
        return max(rounded(time / problem.period * (1 + percent / 100) - sign), 0) * problem.period

    times = problem.dead_time
    inputs = {name: changed(time) for name, time in times.inputs.items()}
    return replace(problem, dead_time=replace(times, inputs=inputs, measurement=changed(times.measurement)))


def roomy(problem: Problem, percent: float) -> Problem:
    """Return the problem with queues for dead times that are longer by so many percent, as `scaled` makes them."""
    times, most = problem.dead_time, scaled(problem, percent).dead_time
    longest = {**most.inputs, MEASUREMENT: most.measurement}
    stated = {n: max(t, times.longest.get(n, 0.0)) for n, t in longest.items() if n in times.queued}
    return replace(problem, dead_time=replace(times, longest={**times.longest, **stated}))


def is_late(problem: Problem) -> bool:
    """Whether there is a dead time."""
    return bool(problem.dead_time.measurement or any(problem.dead_time.inputs.values()))


class StateSlopes(NamedTuple):
    """A (nx, nx), B (nx, nu), C (n, nx), D (n, nu), Y (sum of relative orders, nx), of the controlled coordinates or outputs."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    y: np.ndarray


def state_slopes(plant: Plant, state: np.ndarray, command: np.ndarray, parameters: np.ndarray) -> StateSlopes:
    """Return the slopes at a point; those of a map are of its divided differences."""
    return StateSlopes(*(np.asarray(m.full()) for m in _function(plant)(state, command, parameters)))


def below_responses(plant: Plant) -> list[int]:
    """Return the places in `output` of controlled quantities and of their derivatives below the response; none of order 0."""
    orders = plant.response_orders
    return [k for k, e in enumerate(plant.output.elements) if orders.get(e.rstrip("'"), 0)]


@lru_cache(maxsize=8)  # several questions of a review need it
def _function(plant: Plant) -> ca.Function:
    x, u, p = plant.symbols()
    rates, responses = plant.equations.rate(x, u, p), plant.equations.controlled_response(x, u, p)
    shown = plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names)))
    chain = ca.vertcat(ca.SX(0, 1), *(shown[k] for k in below_responses(plant)))
    pairs = ((rates, x), (rates, u), (responses, x), (responses, u), (chain, x))
    return ca.Function("fpirhc_state_slopes", [x, u, p], [ca.densify(ca.jacobian(one, by)) for one, by in pairs])


_POINTS = 41
_DRAWS = 64
_INNER_DRAWS = 16  # where each has inner states that are simulated
_FINE = 2001  # times of the plant's own inner states


@dataclass(frozen=True, eq=False)
class ReviewGrid:
    """Points of the reference and draws of the parameters; build it with `review_grid`."""

    problem: Problem
    times: np.ndarray  # times of the points, shape (m,)
    # states of the reference, shape (m, nx); inner ones are simulated with the exact parameters, see `inner`
    states: np.ndarray
    responses: np.ndarray  # responses of the controlled coordinates that the reference needs, shape (m, n)
    draws: np.ndarray  # exact parameters, shape (draws, np); the first row is the plant's own
    inner: tuple[int, ...] = ()  # places of the simulated states
    mismatch: float = 0.0  # range of the exact parameters and of the dead times, percent
    # the problem with its reality, where it has one that is a plant; `problem` is then that of the model alone
    real: Problem | None = None
    # whether a run moves something else than the model's plant, so that its exact parameters move nothing
    elsewhere: bool = False
    states_dead_time: str = "Problem(dead_time=...)"  # where a user states the dead time of what a run moves

    @property
    def outside(self) -> bool:
        """Whether the plant is a simulator of somebody else, which a review does not run."""
        return self.elsewhere and self.real is None

    @cached_property
    def drawn_states(self) -> np.ndarray:
        """States of the reference with the inner states that each draw has, shape (draws, m, nx)."""
        states = np.tile(self.states, (len(self.draws), 1, 1))
        if self.inner:
            for rows, motion in zip(
                states[1:], inner_motion(self.problem, self.inner, self.draws[1:], self.times), strict=True
            ):
                rows[:, list(self.inner)] = np.nan if motion is None else motion
        return states

    def states_at(self, times: np.ndarray) -> np.ndarray:
        """Return states of the reference with the plant's own inner states, shape (k, nx)."""
        plant = self.problem.plant
        run = _REFERENCES.of((self.problem.reference, plant), (len(times),), lambda: self._reference(len(times)))
        states = filled(plant, run(times)[0].reshape(len(times), -1))
        if self.inner:
            grid, motion = self._fine
            for place, column in zip(self.inner, motion.T, strict=True):
                states[:, place] = np.interp(times, grid, column)
        return states

    def _reference(self, count: int) -> Evaluator:
        return Evaluator(self.problem.reference.function(self.problem.plant).map(count))

    @cached_property
    def _fine(self) -> tuple[np.ndarray, np.ndarray]:
        """Times, and the inner states with the exact parameters."""
        times = np.linspace(0.0, self.problem.duration, _FINE)
        [motion] = inner_motion(self.problem, self.inner, self.draws[:1], times)
        if motion is None:  # the coarse points, which `review_grid` has found finite
            return self.times, self.states[:, list(self.inner)]
        return times, motion

    @cached_property
    def commands(self) -> np.ndarray:
        """Inputs that the reference needs, per draw and point, shape (draws, m, nu); NaN where there is no inverse."""
        m, k = len(self.times), len(self.draws)
        states, responses = self.drawn_states.reshape(k * m, -1), np.tile(self.responses, (k, 1))
        commands = each(self.problem.plant.equations.inverse, states, responses, np.repeat(self.draws, m, axis=0))
        return commands.reshape(k, m, -1)

    def needed(self, parameters: np.ndarray) -> np.ndarray:
        """Inputs that the reference needs with these parameters, shape (m, nu)."""
        return each(self.problem.plant.equations.inverse, self.states, self.responses, self._rows(parameters))

    def with_exact(self, parameters: np.ndarray) -> ReviewGrid:
        """Return the points of a plant with these exact parameters and inner states of its own; itself where they are the same."""
        if not self.inner or np.array_equal(parameters, self.draws[0]):
            return self
        return _MODELS.of((self,), (parameters.tobytes(),), lambda: self._moved(parameters))

    def _moved(self, parameters: np.ndarray) -> ReviewGrid:
        [motion] = inner_motion(self.problem, self.inner, parameters[None, :], self.times)
        states = self.states.copy()
        if motion is not None:
            states[:, list(self.inner)] = motion
        return replace(self, states=states, draws=np.vstack([parameters[None, :], self.draws[1:]]))

    def requests(self, believed: np.ndarray) -> np.ndarray:
        """Requests r* of a controller with the believed parameters along the reference, shape (m, n)."""
        function = self.problem.plant.equations.controlled_response
        return each(function, self.states, self.commands[0], self._rows(believed))

    def _rows(self, parameters: np.ndarray) -> np.ndarray:
        return np.tile(parameters, (len(self.times), 1))


_REFERENCES: Latest[Evaluator] = Latest(4)  # at so many times


_MODELS: Latest[ReviewGrid] = Latest(4)


def review_grid(problem: Problem, mismatch: float, seed: int) -> ReviewGrid:
    """Return the points and draws of a review. `mismatch`: range of the exact parameters, percent, see `fpirhc.plant.plant`."""
    elsewhere, known = problem.reality is not None, problem.of_equations
    real, stated_in = known if known.reality else None, problem.moves.states_dead_time
    problem = problem.of_model
    plant = problem.plant
    times = np.linspace(0.0, problem.duration, _POINTS)
    nominal = nominal_motion(problem).map(_POINTS)(times[None, :])
    followed, responses = (np.asarray(v.full()).T for v in nominal)
    states = filled(plant, followed)
    ranges = exact_ranges(plant, mismatch)
    lower, upper = (np.array([ranges[name][k] for name in plant.parameters]) for k in (0, 1))
    inner = inner_places(problem)
    draws = _draws(lower, upper, plant.approximate, np.random.default_rng(seed), _INNER_DRAWS if inner else _DRAWS)
    rows = np.vstack([plant.exact[None, :], draws])
    own = inner_motion(problem, inner, rows[:1], times)[0] if inner else None
    if own is None:
        inner = ()
    else:
        states[:, list(inner)] = own
    return ReviewGrid(problem, times, states, responses, rows, inner, mismatch, real, elsewhere, stated_in)


def _draws(
    lower: np.ndarray, upper: np.ndarray, approximate: np.ndarray, random: np.random.Generator, most: int
) -> np.ndarray:
    """Corners of the range, all of them where they are few; the approximate parameters; and points inside and between."""
    free = np.flatnonzero(upper > lower)
    corners = np.zeros((0, lower.size))
    if free.size:
        if 2**free.size <= most:
            signs = np.array(np.meshgrid(*[[0.0, 1.0]] * free.size)).reshape(free.size, -1).T
        else:
            signs = random.integers(0, 2, size=(most, free.size)).astype(float)
        corners = np.repeat(lower[None, :], len(signs), axis=0)
        corners[:, free] += signs * (upper - lower)[free]
    if not free.size and np.array_equal(lower, approximate):
        return corners
    inside = lower + random.uniform(size=(most // 2, lower.size)) * (upper - lower)
    # Without a mismatch the range is a point, and the draws are evenly spaced on the way to the approximate parameters.
    shares = (random.uniform(size=most // 2) if free.size else np.arange(1, most // 2 + 1) / (most // 2 + 1))[:, None]
    return np.vstack([corners, approximate[None, :], (1 - shares) * inside + shares * approximate])


def each(function: ca.Function, *arguments: np.ndarray) -> np.ndarray:
    """Return the values of a Function of columns at every row of its arguments, shape (rows, size)."""
    count = len(arguments[0])
    [table] = Evaluator(function.map(count))(*arguments)
    return table.reshape(count, -1)
