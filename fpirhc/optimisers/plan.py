"""Open-loop solves: a plan as numbers, which can verify itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.rollout import rollout
from fpirhc.optimisers.base import Optimiser, judge
from fpirhc.optimisers.multipliers import fit_multipliers
from fpirhc.status import Status

_SHRINKING = 0.9  # a violation counts as shrinking below this share of the last one


@dataclass(frozen=True, eq=False)
class Plan:
    """A solved horizon.

    inputs (nu, N), states (ns, N + 1). cost, stationarity, feasibility as defined in `fpirhc.optimisers.base`; iterations as far as
    the optimiser tells (-1: it does not); calls of its step; status.
    """

    inputs: np.ndarray
    states: np.ndarray
    cost: float
    stationarity: float
    feasibility: float
    iterations: float
    calls: int
    status: Status
    _ocp: OptimalControl
    _data: np.ndarray
    _bounds: tuple[np.ndarray, np.ndarray]

    @cached_property
    def state_multipliers(self) -> np.ndarray:
        """Multipliers of the state bounds, shape (ns, N), fitted to the plan itself: the optimiser is not asked."""
        return fit_multipliers(self._ocp, self.inputs, self.states[:, 0], self._data, self._bounds)

    def verify(self) -> tuple[float, float, float]:
        """Recompute (cost, stationarity, feasibility) from the problem's own functions."""
        ocp = self._ocp
        found = judge(ocp)(self.inputs, self.states[:, 0], self._data, *self._bounds, self.state_multipliers)
        cost, stationarity, feasibility = (float(v) for v in found)
        return cost, stationarity, feasibility


def solve(
    ocp: OptimalControl,
    optimiser: Optimiser,
    state: np.ndarray,
    data: np.ndarray,
    *,
    calls: int = 50,
    start: np.ndarray | None = None,
) -> Plan:
    """Solve one horizon open loop: call the optimiser's step until its status is OK, at most `calls` times.

    A plan that violates a state bound is improved further as long as the violation shrinks.

    Parameters: `state` s_0 (ns,), `data` (ntheta, N + 1), `start` a first plan (nu, N), zero when not given.

    Raises:
        NotSupported: the optimiser cannot serve the problem.
    """
    optimiser.check(ocp)
    step, layout = optimiser.converging(ocp), optimiser.memory(ocp)
    memory = layout.start()
    bounds = (ocp.input_lower, ocp.input_upper)
    inputs = np.zeros((ocp.input.size, ocp.stages)) if start is None else np.asarray(start, dtype=float)
    memory[layout.slice("plan_inputs")] = inputs.ravel(order="F")
    status, count = Status.NOT_CONVERGED, 0
    diagnostics = np.zeros(5)
    iterations = 0.0
    violation, better = np.inf, True
    while status in (Status.NOT_CONVERGED, Status.INFEASIBLE) and better and count < calls:
        given = step(state, data, *bounds, memory)
        inputs, diagnostics, memory = (np.asarray(v.full()) for v in given)
        diagnostics, memory = diagnostics.ravel(), memory.ravel()
        iterations += diagnostics[3]
        status, count = Status(int(diagnostics[4])), count + 1
        better = status == Status.NOT_CONVERGED or diagnostics[2] < _SHRINKING * violation
        violation = diagnostics[2]
    states = np.asarray(rollout(ocp)(state, inputs, data)[0].full())
    return Plan(
        inputs,
        states,
        float(diagnostics[0]),
        float(diagnostics[1]),
        float(diagnostics[2]),
        iterations if diagnostics[3] >= 0 else -1.0,
        count,
        status,
        ocp,
        np.asarray(ca.DM(data).full()),
        bounds,
    )
