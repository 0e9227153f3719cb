"""How much the desired response of a controller changes: what a deformation with automatic settings chooses them by.

The sigmoid, for one, moves the request by at most 0.81 S per cycle (for D = 0.3), so S must cover the largest change of the
desired response per cycle, or the loop falls behind and diverges. A tracking law asks for what its reference asks; a plan
may move between the input limits within one cycle.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Demand
from fpirhc.errors import InvalidValue
from fpirhc.task.problem import Problem

_SAMPLES = 2000


def reference_demand(problem: Problem) -> Demand:
    """Return period max|d/dt r^N|, r^N the nominal response: it goes on from cycle to cycle."""
    t = ca.MX.sym("t")
    responses = problem.reference.function(problem.plant)(t)[1][list(problem.plant.controlled_indices)]
    return Demand(problem.period * _slew(ca.Function("r", [t], [responses]), problem.duration), sudden=False)


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


def _slew(function: ca.Function, duration: float) -> float:
    """Largest |d/dt| of a Function of time over the run, sampled."""
    times = np.linspace(0.0, duration, _SAMPLES)
    values = np.asarray(function.map(_SAMPLES)(times[None, :]).full())
    return float(np.max(np.linalg.norm(np.diff(values, axis=1), axis=0)) / (times[1] - times[0]))
