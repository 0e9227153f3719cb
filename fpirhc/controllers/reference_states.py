"""What a reference asks of the model and of a deformation: states, responses, the largest one within the limits, its changes.

    L_i = max over the reference and the start of   |f_i(x, c)| + sum_k max |f_i(x, c with u_k at a limit) - f_i(x, c)|

with the model f and the middle c of the limits; exact for a model that is affine in its inputs. Laws and maps compare what they
remember with multiples of it, so that one absurd but finite sample does not stay with them.
"""

from __future__ import annotations

import math
from functools import lru_cache

import casadi as ca
import numpy as np

from fpirhc.deformation.base import RequestChange
from fpirhc.errors import InvalidValue
from fpirhc.plant.chain import nominal_responses
from fpirhc.summary import written_out
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.problem import Problem
from fpirhc.task.reference import pairs
from fpirhc.tracking.base import Tracking, one_rate

_TURNS = {"rad": 2 * np.pi, "deg": 360.0, "°": 360.0}  # a whole turn by unit
_NEAR = 0.05  # share of a turn that a jump of whole turns may be off, because the reference moves within a cycle
_OWN = 0.25  # share of a turn per cycle, up to which an angle moves by itself


def nominal_motion(problem: Problem) -> ca.Function:
    """Return the Function time -> (nominal outputs, nominal responses of the controlled ones)."""
    t = ca.MX.sym("t")
    outputs, responses = problem.reference.function(problem.plant)(t)
    return ca.Function("fpirhc_wanted", [t], [outputs, nominal_responses(problem.plant, outputs, responses)])


def reference_states(problem: Problem, count: int) -> np.ndarray:
    """Return states at evenly spaced instants of a run, shape (nx, count); NaN after a nominal run that does not stay finite."""
    plant, times = problem.plant, np.linspace(0.0, problem.duration, count)
    if plant.equations.hidden:
        places = np.round(times / problem.period).astype(int)
        return problem.nominal_run[:, np.minimum(places, problem.nominal_run.shape[1] - 1)]
    outputs = problem.reference.function(plant).map(count)(times[None, :])[0]
    return np.asarray(plant.equations.state_of(outputs, outputs).full())


def reference_inputs(problem: Problem, count: int) -> np.ndarray:
    """Return the model's inputs beside these states, shape (nu, count), by its inverse.

    Those before the run stand for a model with more or fewer inputs than controlled coordinates.
    """
    plant, times = problem.plant, np.linspace(0.0, problem.duration, count)
    if len(plant.controlled_names) != len(plant.inputs):
        return np.repeat(problem.inputs_before[:, None], count, axis=1)
    states, repeated = reference_states(problem, count), np.repeat(plant.approximate[:, None], count, axis=1)
    wanted = nominal_motion(problem).map(count)(times[None, :])[1]
    return np.asarray(plant.equations.inverse.map(count)(states, wanted, repeated).full())


_SAMPLES = 100  # instants at which the reference is looked at


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


def needed_commands(problem: Problem, run: np.ndarray, *, exact: bool = False) -> np.ndarray:
    """Return the inputs that the model needs along the reference, shape (cycles, nu); states without one are those of a run."""
    plant, count = problem.plant, min(problem.cycles, len(run))
    outputs, responses = (rows[:count] for rows in reference(problem))
    known = run[:count] if run.shape[1] == plant.state.size else np.full((count, plant.state.size), np.nan)
    states = np.asarray(plant.equations.state_of(ca.DM(outputs.T), ca.DM(known.T)).full()).T
    given = plant.exact if exact else plant.approximate
    [table] = Evaluator(plant.equations.inverse.map(count))(states, responses, np.tile(given, (count, 1)))
    return table.reshape(count, -1)


def beyond_limits(problem: Problem) -> list[str]:
    """Return a sentence where the reference needs more of an input, of the plant where it is known, than its limits give."""
    plant, ends = problem.plant, np.abs(problem.limits.input_bounds(problem.plant)).max(axis=0)
    states, known = np.full((problem.cycles, plant.state.size), np.nan), problem.reality is None
    asked = np.abs(needed_commands(problem, states, exact=known and problem.moves.simulated)).max(axis=0)
    needed = {name: one / end for name, one, end in zip(plant.inputs, asked, ends, strict=True) if one > end > 0}
    said = "The reference needs {} times the limits of {}: widen them, or ask for less."
    return [said.format(written_out(times), name) for name, times in needed.items() if times < math.inf]


def largest_response(problem: Problem) -> tuple[float, ...]:
    """Return L of every controlled coordinate, by the limits of the build; infinite where an input has no finite limits.

    It is rounded up by less than a tenth, so that many starts have one loop. It is infinite too where the states that belong to the
    reference are not known before a run.
    """
    free = (float("inf"),) * len(problem.plant.controlled_names)
    largest = free if problem.plant.equations.hidden else _largest_response(problem)
    rounded = (2.0 ** (math.ceil(_STEPS * math.log2(v)) / _STEPS) if 0 < v < math.inf else v for v in largest)
    return tuple(map(float, rounded))


_STEPS = 8  # per doubling


@lru_cache(maxsize=8)  # several blocks of one loop ask for it, and every controller of a comparison
def _largest_response(problem: Problem) -> tuple[float, ...]:
    """L of every controlled coordinate, not rounded; of outputs along the model's nominal run."""
    lower, upper = problem.limits.input_bounds(problem.plant)
    if not np.isfinite(upper - lower).all():
        return (float("inf"),) * len(problem.plant.controlled_names)
    states = np.hstack([reference_states(problem, _SAMPLES), np.asarray(problem.start_state)[:, None]])
    middle, inputs = (lower + upper) / 2, np.arange(lower.size)
    corners = [middle, *(np.where(inputs == k, end[k], middle) for k in inputs for end in (lower, upper))]
    commands, every = np.repeat(corners, states.shape[1], axis=0).T, np.tile(states, len(corners))
    model = np.repeat(problem.plant.approximate[:, None], every.shape[1], axis=1)
    responses = problem.plant.equations.controlled_response.map(every.shape[1])(every, commands, model).full()
    at_middle, *at_limits = np.split(np.asarray(responses), len(corners), axis=1)
    with np.errstate(all="ignore"):
        reach = [
            np.fmax(abs(low - at_middle), abs(high - at_middle))
            for low, high in zip(at_limits[::2], at_limits[1::2], strict=True)
        ]
        sizes = abs(at_middle) + sum(reach)
    finite = np.where(np.isfinite(sizes), sizes, 0.0).max(axis=1)
    return tuple(float(v) if v > 0 else float("inf") for v in finite)


_INSTANTS = 2000


def request_along_reference(problem: Problem, law: Tracking | None = None) -> RequestChange:
    """Return the change period max|d/dt r^N| of the nominal response r^N, or its largest jump, with the recovery for `law`."""
    motion, period = nominal_motion(problem), problem.period

    def responses(times: np.ndarray) -> np.ndarray:
        return np.asarray(motion.map(times.size)(times[None, :])[1].full())

    times, steps = np.linspace(0.0, problem.duration, _INSTANTS), problem.reference.set_points.items()
    change = period * _steepest(responses(times), times)
    if jumps := sorted({time for name, one in steps for time, _ in pairs(name, one) if time > 0}):
        # No derivative shows them.
        begins = np.append(np.linspace(0.0, problem.duration - period, _INSTANTS), np.array(jumps) - period)
        change = float(np.linalg.norm(responses(begins + period) - responses(begins), axis=0).max())
    return RequestChange(change, sudden=False, recovery=_recovery(problem, law))


def request_of_plans(problem: Problem) -> RequestChange:
    """Return the jump of the model's response when the command jumps from limit to limit in one cycle."""
    plant = problem.plant
    lower, upper = problem.limits.input_bounds(plant)
    if not np.all(np.isfinite(upper - lower)):
        free = [e for e, r in zip(plant.input.elements, upper - lower, strict=True) if not np.isfinite(r)]
        raise InvalidValue(
            f"the scale of the deformation cannot be chosen: input '{free[0]}' has no finite limits, so the desired response "
            "may jump by any amount; give the deformation its scale (Sigmoid(scale=...)), or Limits(inputs=...)"
        )
    at_start = plant.equations.input_gain(problem.start_state, (lower + upper) / 2, plant.approximate).full()
    return RequestChange(float(np.linalg.norm(np.abs(at_start) @ (upper - lower))), sudden=True)


def request_of_commands(problem: Problem) -> RequestChange:
    """Return the change period max|dQ/dt| of the command Q that the model needs along the reference."""
    values, times = reference_inputs(problem, _INSTANTS), np.linspace(0.0, problem.duration, _INSTANTS)
    return RequestChange(problem.period * _steepest(values, times), sudden=False)


def _recovery(problem: Problem, law: Tracking | None) -> float:
    """Step per cycle with which the plain form comes back from the largest expected error; 0 without a law of one rate."""
    laws = [law.gains(order) for order in {*problem.plant.response_orders.values()}] if law else []
    rates = [(len(gains), rate) for gains in laws if gains and (rate := one_rate(gains)) is not None]
    if not rates:
        return 0.0
    from fpirhc.contraction.delayed import step_for_basin  # of laws with one rate alone

    error = _largest_error(problem)
    return max(step_for_basin(error, poles, rate, problem.period) for poles, rate in rates)


def _largest_error(problem: Problem) -> float:
    """Largest |r^N - response(x^N, 0)| of the model along the reference, over the samples where it is finite."""
    plant, times = problem.plant, np.linspace(0.0, problem.duration, _INSTANTS)
    states = reference_states(problem, _INSTANTS)
    wanted = np.asarray(nominal_motion(problem).map(_INSTANTS)(times[None, :])[1].full())
    model, still = np.repeat(plant.approximate[:, None], _INSTANTS, axis=1), np.zeros((plant.input.size, _INSTANTS))
    free = np.asarray(plant.equations.controlled_response.map(_INSTANTS)(states, still, model).full())
    sizes = np.linalg.norm(wanted - free, axis=0)
    return float(sizes[np.isfinite(sizes)].max(initial=0.0))


def _steepest(values: np.ndarray, times: np.ndarray) -> float:
    """Largest |difference| of neighbours, per unit of time."""
    return float(np.max(np.linalg.norm(np.diff(values, axis=1), axis=0)) / (times[1] - times[0]))
