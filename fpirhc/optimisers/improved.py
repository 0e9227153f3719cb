"""Calls of an optimiser's converging step until a plan is solved, rescued where it does not converge."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import Optimiser, built
from fpirhc.status import Status

_PATIENCE = 4  # calls in a row that may leave the violation as it is
_SHRINKING = 0.9  # a violation counts as shrinking below this share of the last one


def improved(
    optimiser: Optimiser,
    ocp: OptimalControl,
    state: np.ndarray,
    data: np.ndarray | ca.DM,
    memory: np.ndarray,
    *,
    calls: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Improve a plan until its status is OK; with a violated limit of a state, as long as the violation shrinks.

    Args:
        optimiser: the optimiser.
        ocp: the problem.
        state: the first state, shape (ns,).
        data: shape (ntheta, N + 1).
        memory: from which the first call begins.
        calls: most calls.

    Returns:
        Plan (nu, N), diagnostics with the iterations of all calls, memory, and the number of calls.
    """
    step, bounds, rescue = built(optimiser, ocp, "converging"), (ocp.input_lower, ocp.input_upper), None
    status, count, iterations, violation, stuck = Status.NOT_CONVERGED, 0, 0.0, np.inf, 0
    inputs, diagnostics = np.zeros((ocp.input.size, ocp.stages)), np.zeros(5)
    while status in (Status.NOT_CONVERGED, Status.INFEASIBLE) and stuck < _PATIENCE and count < calls:
        arguments = (state, data, *bounds, memory)
        results = step(*arguments)
        if int(results[1][4]) != Status.OK:
            # Built only here, because most horizons do not need it.
            rescue = rescue or optimiser.rescue(ocp)
            results = rescue(*arguments, *results) if rescue else results
        inputs, diagnostics, memory = (np.asarray(v.full()) for v in results)
        diagnostics, memory = diagnostics.ravel(), memory.ravel()
        iterations += diagnostics[3]
        status, count = Status(int(diagnostics[4])), count + 1
        better = status == Status.NOT_CONVERGED or diagnostics[2] < _SHRINKING * violation
        stuck, violation = (0 if better else stuck + 1), min(violation, diagnostics[2])
    diagnostics[3] = iterations if diagnostics[3] >= 0 else diagnostics[3]
    return inputs, diagnostics, memory, count
