"""What a reference asks of the model: outputs and responses, and the states that belong to them."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.nominal import known_on_reference, nominal_run
from fpirhc.plant.chain import nominal_responses
from fpirhc.task.problem import Problem, nominal_start


def nominal_motion(problem: Problem) -> ca.Function:
    """Return the Function time -> (nominal outputs, nominal responses of the controlled ones)."""
    t = ca.MX.sym("t")
    outputs, responses = problem.reference.function(problem.plant)(t)
    return ca.Function("fpirhc_wanted", [t], [outputs, nominal_responses(problem.plant, outputs, responses)])


def reference_states(problem: Problem, count: int) -> np.ndarray:
    """Return states at evenly spaced instants of a run, shape (nx, count); NaN after a nominal run that does not stay finite."""
    plant, times = problem.plant, np.linspace(0.0, problem.duration, count)
    if known_on_reference(plant):
        referenced = np.asarray(problem.reference.function(plant).map(count)(times[None, :])[0].full())
        return referenced[list(plant.known_by_outputs)]
    states, _ = nominal_run(plant, problem.reference, *nominal_start(problem))
    places = np.minimum(np.round(times / problem.period).astype(int), states.shape[1] - 1)
    return states[:, places]
