"""How much the desired response of a controller changes: the basis of a deformation's automatic settings.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.contraction.large_errors import step_for_basin
from fpirhc.controllers.reference_states import nominal_motion, reference_states
from fpirhc.deformation.base import Demand
from fpirhc.errors import InvalidValue
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking

_SAMPLES = 2000


def reference_demand(problem: Problem, law: Tracking | None = None) -> Demand:
    """Return the change period max|d/dt r^N| of the nominal response r^N, or its largest jump, with the recovery for `law`."""
    t = ca.MX.sym("t")
    responses = nominal_motion(problem)(t)[1]
    response_of, jump = ca.Function("r", [t], [responses]), problem.reference.largest_jump(problem.plant)
    smooth = problem.period * _slew(response_of, problem.duration)
    change = max(jump, _largest_change(response_of, problem)) if jump else smooth
    return Demand(change, sudden=False, recovery=_recovery(problem, law))


def plan_demand(problem: Problem) -> Demand:
    """Return the jump of the model's response when the command jumps from limit to limit in one cycle.

    Raises:
        InvalidValue: some input has no finite limits, so the jump has no bound.
    """
    plant = problem.plant
    lower, upper = problem.limits.input_bounds(plant)
    if not np.all(np.isfinite(upper - lower)):
        free = [e for e, r in zip(plant.input.elements, upper - lower, strict=True) if not np.isfinite(r)]
        raise InvalidValue(
            f"the scale of the deformation cannot be chosen: input '{free[0]}' has no finite limits, so the desired response "
            "may jump by any amount; give the deformation its scale (Sigmoid(scale=...)), or Limits(inputs=...)"
        )
    x, u, p = plant.symbols()
    gain = ca.Function("g", [x, u, p], [ca.jacobian(plant.equations.controlled_response(x, u, p), u)])
    at_start = np.asarray(gain(problem.start_state, (lower + upper) / 2, plant.approximate).full())
    return Demand(float(np.linalg.norm(np.abs(at_start) @ (upper - lower))), sudden=True)


def command_demand(problem: Problem, parameters: np.ndarray) -> Demand:
    """Return the change period max|dQ/dt| of the command Q that the model with these parameters needs along the reference."""
    plant, times = problem.plant, np.linspace(0.0, problem.duration, _SAMPLES)
    wanted = nominal_motion(problem).map(_SAMPLES)(times[None, :])[1]
    values = plant.equations.inverse.map(_SAMPLES)(
        reference_states(problem, _SAMPLES), wanted, np.repeat(parameters[:, None], _SAMPLES, axis=1)
    )
    return Demand(problem.period * _steepest(np.asarray(values.full()), times), sudden=False)


def _recovery(problem: Problem, law: Tracking | None) -> float:
    """Step per cycle with which the plain form comes back from the largest expected error; 0 without a law of one rate."""
    laws = [law.feedback(order) for order in problem.plant.response_orders.values()] if law else []
    rates = [(len(one.gains), one.rate) for one in laws if one is not None and one.rate is not None and one.gains]
    if not rates:
        return 0.0
    error = _largest_error(problem)
    return max(step_for_basin(error, poles, rate, problem.period) for poles, rate in rates)


def _largest_error(problem: Problem) -> float:
    """Largest |r^N - response(x^N, 0)| of the model along the reference, over the samples where it is finite."""
    plant = problem.plant
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    states = reference_states(problem, _SAMPLES)
    wanted = np.asarray(nominal_motion(problem).map(_SAMPLES)(times[None, :])[1].full())
    model, still = np.repeat(plant.approximate[:, None], _SAMPLES, axis=1), np.zeros((plant.input.size, _SAMPLES))
    free = np.asarray(plant.equations.controlled_response.map(_SAMPLES)(states, still, model).full())
    sizes = np.linalg.norm(wanted - free, axis=0)
    return float(sizes[np.isfinite(sizes)].max(initial=0.0))


def _largest_change(function: ca.Function, problem: Problem) -> float:
    """Largest change of a Function of time over one cycle of the run, sampled."""
    times = np.linspace(0.0, problem.duration - problem.period, _SAMPLES)
    before, after = (np.asarray(function.map(_SAMPLES)(t[None, :]).full()) for t in (times, times + problem.period))
    return float(np.max(np.linalg.norm(after - before, axis=0)))


def _slew(function: ca.Function, duration: float) -> float:
    """Largest |d/dt| of a Function of time over the run, sampled."""
    times = np.linspace(0.0, duration, _SAMPLES)
    return _steepest(np.asarray(function.map(_SAMPLES)(times[None, :]).full()), times)


def _steepest(values: np.ndarray, times: np.ndarray) -> float:
    """Largest |difference| of neighbours, per unit of time."""
    return float(np.max(np.linalg.norm(np.diff(values, axis=1), axis=0)) / (times[1] - times[0]))
