"""The automatic choice of a sigmoid's scale S.

The sigmoid moves the request by at most 0.81 S per cycle (for D = 0.3), so S must cover the largest change of the desired
response per cycle, or the loop falls behind and diverges. A tracking law asks for what its reference asks; a plan may
move between the input limits within one cycle.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.deformation.sigmoid import Sigmoid
from fpirhc.deformation.wrappers.base import Wrapper
from fpirhc.errors import InvalidValue
from fpirhc.task.problem import Problem

_SAMPLES = 2000


def scaled_for_reference(deformation: Deformation, problem: Problem) -> Deformation:
    """Return the deformation with S = max(1, 2 period max|d/dt r^N|), r^N the nominal response, unless S is given."""
    if isinstance(deformation, Wrapper):
        return replace(deformation, map=scaled_for_reference(deformation.map, problem))
    if not _is_open(deformation):
        return deformation
    return _with_scale(deformation, max(1.0, 2 * problem.period * _reference_slew(problem)))


def scaled_for_plan(deformation: Deformation, problem: Problem) -> Deformation:
    """Return the deformation with S covering a jump of the command from limit to limit in one cycle, unless S is given.

    Raises:
        InvalidValue: some input has no finite limits, so nothing bounds the jump.
    """
    if isinstance(deformation, Wrapper):
        return replace(deformation, map=scaled_for_plan(deformation.map, problem))
    if not _is_open(deformation):
        return deformation
    plant = problem.plant
    lower, upper = problem.limits.input_bounds(plant)
    if not np.all(np.isfinite(upper - lower)):
        free = [e for e, r in zip(plant.input.elements, upper - lower, strict=True) if not np.isfinite(r)]
        raise InvalidValue(
            f"the scale of Sigmoid cannot be chosen: input '{free[0]}' has no finite limits, so the desired response may "
            "jump by any amount; give Sigmoid(scale=...) or Limits(inputs=...)"
        )
    x, u, p = plant._symbols()
    gain = ca.Function("g", [x, u, p], [ca.jacobian(plant.controlled_response_function(x, u, p), u)])
    at_start = np.asarray(gain(problem.start_state, (lower + upper) / 2, plant.approximate).full())
    jump = float(np.linalg.norm(np.abs(at_start) @ (upper - lower)))
    return _with_scale(deformation, max(1.0, jump / replace_scale(deformation, 1.0).largest_step()))


def scaled_for_command(deformation: Deformation, problem: Problem, parameters: np.ndarray) -> Deformation:
    """Return the deformation with S = max(1, 2 period max|dQ/dt|), Q the model's command along the reference."""
    if isinstance(deformation, Wrapper):
        return replace(deformation, map=scaled_for_command(deformation.map, problem, parameters))
    if not _is_open(deformation):
        return deformation
    reference, inverse = problem.reference.function(problem.plant), problem.plant.inverse_function
    t, p = ca.MX.sym("t"), ca.DM(parameters)
    state, response = reference(t)
    command = ca.Function("c", [t], [inverse(state, response[list(problem.plant.controlled_indices)], p)])
    return _with_scale(deformation, max(1.0, 2 * problem.period * _slew(command, problem.duration)))


def replace_scale(deformation: Deformation, scale: float) -> Deformation:
    """Return the same sigmoid with another scale."""
    assert isinstance(deformation, Sigmoid)
    return replace(deformation, scale=scale)


def _is_open(deformation: Deformation) -> bool:
    return isinstance(deformation, Sigmoid) and deformation.scale is None


def _with_scale(deformation: Deformation, scale: float) -> Deformation:
    return replace_scale(deformation, float(f"{scale:.3g}"))


def _reference_slew(problem: Problem) -> float:
    """Largest |d/dt r^N| over the run, sampled."""
    t = ca.MX.sym("t")
    responses = problem.reference.function(problem.plant)(t)[1][list(problem.plant.controlled_indices)]
    return _slew(ca.Function("r", [t], [responses]), problem.duration)


def _slew(function: ca.Function, duration: float) -> float:
    """Largest |d/dt| of a Function of time over the run, sampled."""
    times = np.linspace(0.0, duration, _SAMPLES)
    values = np.asarray(function.map(_SAMPLES)(times[None, :]).full())
    return float(np.max(np.linalg.norm(np.diff(values, axis=1), axis=0)) / (times[1] - times[0]))
