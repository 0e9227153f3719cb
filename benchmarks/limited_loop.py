"""A closed loop that plans in every stage: what is applied, what it costs, and how long the plans take.

The plan call is the one that `RecedingHorizon` makes: the optimiser's `step`, compiled, with its memory shifted by one stage.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from foreign import Foreign

import fpirhc as fp
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import stage_data
from fpirhc.optimisers.base import Optimiser
from fpirhc.optimisers.bounds import scales
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.native import native


@dataclass(frozen=True)
class Plan:
    """Inputs (nu, N), what the optimiser says of them, and what it took."""

    inputs: np.ndarray
    status: fp.Status
    iterations: float
    microseconds: float


Planner = Callable[[np.ndarray, np.ndarray], Plan]


@dataclass(frozen=True)
class Loop:
    """Per cycle: first state and data of the horizon, its plan, and the state of the plant (n + 1, nx).

    Args:
        cost: sum of the stage costs.
        violation: worst violation of the limits of states and paths, in half ranges.
    """

    first: list[np.ndarray] = field(default_factory=list)
    data: list[np.ndarray] = field(default_factory=list)
    plans: list[Plan] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)
    cost: float = 0.0
    violation: float = 0.0


def closed(case: Foreign, ocp: OptimalControl, planner: Planner, cycles: int, *, right: bool) -> Loop:
    """Plan with the approximate parameters, apply the first input, and let the plant move with these or with its own."""
    plant, loop, cost, violation = case.plant, Loop(), 0.0, 0.0
    data_of = stage_data(plant, case.reference, case.horizon, case.cost)
    advance = fp.RungeKutta4(4).step(plant, case.horizon.step)
    parameters = plant.approximate if right else plant.exact
    x = np.array([case.start.get(e, 0.0) for e in plant.state.elements])
    s0, unit = case.first(ocp, x), scales(ocp).states
    for k in range(cycles):
        data = np.asarray(data_of(k * case.horizon.step, plant.approximate).full())
        plan = planner(s0, data)
        u = plan.inputs[:, 0]
        for name, value in (("first", s0), ("data", data), ("plans", plan), ("states", x)):
            getattr(loop, name).append(value)
        cost += float(ocp.stage_cost(s0, u, data[:, 0])[0])
        true = np.asarray(data_of(k * case.horizon.step, parameters).full())[:, 0]
        reached = np.asarray(ocp.dynamics(s0, u, true).full()).ravel()  # for its paths and rates
        x = np.asarray(advance(x, u, parameters, np.zeros(len(plant.names))).full()).ravel()
        reached[: x.size] = x
        violation = max(violation, *((ocp.state_lower - reached) / unit), *((reached - ocp.state_upper) / unit))
        s0 = np.asarray(ocp.start(x, u).full()).ravel()
        if not np.isfinite(x).all():
            break
    loop.states.append(x)
    return Loop(loop.first, loop.data, loop.plans, loop.states, cost, violation)


class OwnPlans:
    """A Function of an optimiser of this package, compiled and called as a loop calls it.

    Args:
        optimiser: whose memory it is, and its shift.
        ocp: the problem.
        function: `step` or `converging`.
        repeats: how often each call is timed; the shortest counts.
    """

    def __init__(self, optimiser: Optimiser, ocp: OptimalControl, function: ca.Function, repeats: int = 3) -> None:
        self._optimiser, self._ocp, self._repeats = optimiser, ocp, repeats
        self._call = Evaluator(native(function).function)
        memory = ca.MX.sym("memory", optimiser.memory(ocp).size)
        self._shift = ca.Function("fpirhc_shift", [memory], [optimiser.shifted(ocp, memory)])
        self.memory: np.ndarray | None = None

    def __call__(self, s0: np.ndarray, data: np.ndarray) -> Plan:
        """Return the plan of this cycle."""
        ocp, call = self._ocp, self._call
        if self.memory is None:
            self.memory = self._optimiser.first_memory(ocp, s0, data)
        for place, value in enumerate((s0, data.T, ocp.input_lower, ocp.input_upper, self.memory)):
            call.arguments[place][...] = value
        taken = np.inf
        for _ in range(self._repeats):
            begin = time.thread_time_ns()
            call.evaluate()
            taken = min(taken, time.thread_time_ns() - begin)
        inputs, told = call.results[0].reshape(ocp.stages, -1).T.copy(), call.results[1].copy()
        self.memory = np.asarray(self._shift(call.results[2]).full()).ravel()
        return Plan(inputs, fp.Status(int(told[4])), float(told[3]), taken / 1e3)
