"""What an optimiser remembers before a run: the plan for the first horizon, at the problem's start.

A loop, a stepper and a review of one problem begin with the same plan, and so do controllers that share an optimiser. Solving it
takes about half of the time in which a receding horizon is composed, so the latest ones are remembered.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import Optimiser
from fpirhc.symbolic.latest import Latest
from fpirhc.task.problem import Problem

_LATEST: Latest[np.ndarray] = Latest(8)


def built_first_memory(problem: Problem, optimiser: Optimiser, ocp: OptimalControl, data_of: ca.Function) -> np.ndarray:
    """Return `first_memory` with the numbers of the build; the data are those of this horizon at this start."""
    start = problem.start_state.tobytes(), np.asarray(problem.inputs_before, dtype=float).tobytes()
    memory = _LATEST.of((ocp, optimiser), start, lambda: first_memory(problem, optimiser, ocp, data_of))
    return memory.copy()


def first_memory(problem: Problem, optimiser: Optimiser, ocp: OptimalControl, data_of: ca.Function) -> np.ndarray:
    """Return the optimiser's memory before the run.

    Args:
        problem: with numbers for its live settings.
        optimiser: of the plans.
        ocp: the horizon.
        data_of: Function (time, parameters, live numbers) -> data of the horizon.
    """
    first = np.asarray(ocp.start(problem.start_state, problem.inputs_before).full()).ravel()
    live = ocp.nodes[2][ocp.data.slice("settings").start :, 0] if ocp.settings else None
    arguments = (0.0, problem.plant.approximate)
    table = data_of(*arguments) if live is None else data_of(*arguments, live)
    return optimiser.first_memory(ocp, first, np.asarray(table.full()))
