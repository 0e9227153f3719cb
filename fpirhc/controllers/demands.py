"""How much the desired response of a controller changes: what a deformation with automatic settings chooses them by.

The sigmoid, for one, moves the request by at most 0.81 S per cycle (for D = 0.3), so S must cover the largest change of the
desired response per cycle, or the loop falls behind and diverges. A tracking law asks for what its reference asks; a plan
may move between the input limits within one cycle.

Around a tracking law the step must also cover the errors that the loop is to come back from (`fpirhc.contraction.basin`), whose
size nobody knows before a run. A model is taken to be wrong by no more than its own command does:
|f - d| <= |r^N - response(x^N, 0)|, along the reference.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.contraction import step_for_basin
from fpirhc.deformation.base import Demand
from fpirhc.errors import InvalidValue
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking

_SAMPLES = 2000


def reference_demand(problem: Problem, law: Tracking | None = None) -> Demand:
    """Return period max|d/dt r^N|, r^N the nominal response, which goes on from cycle to cycle, and what `law` needs."""
    t = ca.MX.sym("t")
    responses = problem.reference.function(problem.plant)(t)[1][list(problem.plant.controlled_indices)]
    change = problem.period * _slew(ca.Function("r", [t], [responses]), problem.duration)
    return Demand(change, sudden=False, recovery=_recovery(problem, law))


def plan_demand(problem: Problem) -> Demand:
    """Return a jump of the model's response when the command jumps from limit to limit in one cycle.

    Raises:
        InvalidValue: some input has no finite limits, so nothing bounds the jump.
    """
    plant = problem.plant
    lower, upper = problem.limits.input_bounds(plant)
    if not np.all(np.isfinite(upper - lower)):
        free = [e for e, r in zip(plant.input.elements, upper - lower, strict=True) if not np.isfinite(r)]
        raise InvalidValue(
            f"the scale of the deformation cannot be chosen: input '{free[0]}' has no finite limits, so the desired response "
            "may jump by any amount; give the deformation its scale (Sigmoid(scale=...)), or Limits(inputs=...)"
        )
    x, u, p = plant._symbols()
    gain = ca.Function("g", [x, u, p], [ca.jacobian(plant.controlled_response_function(x, u, p), u)])
    at_start = np.asarray(gain(problem.start_state, (lower + upper) / 2, plant.approximate).full())
    return Demand(float(np.linalg.norm(np.abs(at_start) @ (upper - lower))), sudden=True)


def command_demand(problem: Problem, parameters: np.ndarray) -> Demand:
    """Return period max|dQ/dt|, Q the command that the model with these parameters needs along the reference."""
    reference, inverse = problem.reference.function(problem.plant), problem.plant.inverse_function
    t, p = ca.MX.sym("t"), ca.DM(parameters)
    state, response = reference(t)
    command = ca.Function("c", [t], [inverse(state, response[list(problem.plant.controlled_indices)], p)])
    return Demand(problem.period * _slew(command, problem.duration), sudden=False)


def _recovery(problem: Problem, law: Tracking | None) -> float:
    """Step per cycle from which the plain form comes back from the largest error that is expected; 0 without a law of one rate."""
    plant = problem.plant
    laws = [law.feedback(plant.orders[k]) for k in plant.controlled_indices] if law else []
    rates = [(len(one.gains), one.rate) for one in laws if one is not None and one.rate is not None]
    if not rates:
        return 0.0
    error = _largest_error(problem)
    return max(step_for_basin(error, poles, rate, problem.period) for poles, rate in rates)


def _largest_error(problem: Problem) -> float:
    """Largest |r^N - response(x^N, 0)| of the model along the reference: what its commands do there; 0 where that is not finite."""
    plant = problem.plant
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    states, responses = (np.asarray(v.full()) for v in problem.reference.function(plant).map(_SAMPLES)(times[None, :]))
    model, still = np.repeat(plant.approximate[:, None], _SAMPLES, axis=1), np.zeros((plant.input.size, _SAMPLES))
    free = np.asarray(plant.controlled_response_function.map(_SAMPLES)(states, still, model).full())
    sizes = np.linalg.norm(responses[list(plant.controlled_indices)] - free, axis=0)
    return float(sizes[np.isfinite(sizes)].max(initial=0.0))


def _slew(function: ca.Function, duration: float) -> float:
    """Largest |d/dt| of a Function of time over the run, sampled."""
    times = np.linspace(0.0, duration, _SAMPLES)
    values = np.asarray(function.map(_SAMPLES)(times[None, :]).full())
    return float(np.max(np.linalg.norm(np.diff(values, axis=1), axis=0)) / (times[1] - times[0]))
