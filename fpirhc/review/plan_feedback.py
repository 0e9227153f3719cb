"""A plan near the reference is a feedback of the state, u = u* + K (x - x^N).

K is the first gain of the Riccati recursion over the horizon, with the model linearised along the reference and the cost's own
second derivatives; bounds are left out. `PlanFeedback` is the tracking law with which a plan that restarts from the measured
state enters the linear loop,

    q^Des = (A^ + B^ K) x      in deviations from the reference,

as if the plan were renewed in every cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.horizon.cost import Cost
from fpirhc.horizon.hessian_models import GaussNewton, hessian_end, hessian_stage, linear_stage
from fpirhc.horizon.problem import Horizon, stage_data, transcribe
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking


@dataclass(frozen=True)
class PlanFeedback(Tracking):
    """The feedback of a plan on a linear plant, whose last parameters are the entries of K."""

    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, parameters) -> desired."""
        del period
        target = Signal("_target", plant.state.elements, plant.state.units)
        reads = (plant.state, target, plant.response_signal("nominal"), plant.parameter)
        nx, nu = plant.state.size, plant.input.size

        def step(s: Signals) -> dict[str, Expression]:
            deviation = s.state - s._target
            gains = ca.reshape(s.parameters[plant.parameter.size - nu * nx :], nx, nu).T
            planned = ca.mtimes(gains, deviation)
            return {"desired": s.nominal + plant.controlled_response_function(deviation, planned, s.parameters)}

        return Block("tracking", Layout(reads), Layout((plant.response_signal("desired"),)), step)

    def update(self, plant: Plant, period: float) -> Block:
        """Block without effect: nothing is remembered."""
        del plant, period
        writes = Layout((scalar("_plan_followed"),))
        return Block(
            "tracking_update", Layout((scalar("clipped"),)), writes, lambda s: {"_plan_followed": 1 - s.clipped}
        )

    def delays(self, plant: Plant) -> tuple[Delay, ...]:
        """Nothing is remembered."""
        del plant
        return ()


def plan_gains(
    problem: Problem, horizon: Horizon, cost: Cost, times: Sequence[float], believed: np.ndarray
) -> list[np.ndarray]:
    """Return K of the plans that start on the reference at these times, shape (nu, nx) each.

    Raises:
        NotSupported: the stage's state holds more than the plant's (rates of inputs, an end that must be met).
    """
    plant = problem.plant
    horizon = replace(horizon, margins={})
    ocp = transcribe(plant, problem.reference, horizon, cost, Limits())
    if ocp.state.size != plant.state.size:
        raise NotSupported(
            "a plan that weighs the rate of inputs, or must meet an end, has no feedback of the state alone"
        )
    data_of = stage_data(plant, problem.reference, horizon, cost)
    function, controlled = problem.reference.function(plant), list(plant.controlled_indices)
    linear, curved, end = linear_stage(ocp), hessian_stage(ocp, GaussNewton()), hessian_end(ocp)
    gains = []
    for time in times:
        data = np.asarray(data_of(time, believed).full())
        states = data[ocp.data.slice("reference")]
        clock = time + horizon.step * np.arange(horizon.stages)
        wanted = np.asarray(function.map(horizon.stages)(clock[None, :])[1].full())[controlled]
        repeated = np.repeat(believed[:, None], horizon.stages, axis=1)
        inputs = np.asarray(plant.inverse_function.map(horizon.stages)(states[:, :-1], wanted, repeated).full())
        gains.append(_first_gain((linear, curved, end), states, inputs, data))
    return gains


def longer(horizon: Horizon) -> Horizon:
    """Return the horizon with twice as many stages."""
    return replace(horizon, stages=2 * horizon.stages)


def _first_gain(
    stages: tuple[ca.Function, ca.Function, ca.Function], states: np.ndarray, inputs: np.ndarray, data: np.ndarray
) -> np.ndarray:
    linear, curved, end = stages
    value = np.asarray(end(states[:, -1], data[:, -1])[2].full())
    gain = np.zeros((len(inputs), len(states)))
    for k in reversed(range(inputs.shape[1])):
        at = (states[:, k], inputs[:, k], data[:, k])
        a, b = (np.asarray(m.full()) for m in linear(*at)[2:4])
        q, s, r = (np.asarray(m.full()) for m in curved(*at, np.zeros(len(states))))
        coupled = s + b.T @ value @ a
        gain = -np.linalg.solve(r + b.T @ value @ b, coupled)
        value = q + a.T @ value @ a + coupled.T @ gain
    return gain
