"""A plan near the reference is a feedback of the state and of the input before, u = u* + K (x - x^N) + L (u_before - u*).

K and L are the first gains of the Riccati recursion over the horizon, with the model linearised along the reference and the cost's
own second derivatives. L is zero unless the cost weighs the change of the inputs from stage to stage. Bounds are left out: near the
reference they bind nowhere. An end that must be met, C x_N = 0, enters exactly, by its multiplier,

    V_k(x) = x' P_k x / 2 + x' E_k mu + mu' G_k mu / 2,      E_N = C',  G_N = 0,      mu = -G_0^-1 E_0' x.

`PlanFeedback` is the tracking law with which a plan that restarts from the measured state enters the linear loop,

    q^Des = A^ x + B^ (K x + L u_before)      in deviations from the reference,

as if the plan were renewed in every cycle. The input before is then the command of one stage ago: the plan limits the change of the
inputs per stage and not per cycle. The shift of the command by the deformation is no part of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fpirhc.horizon.cost import Cost
from fpirhc.horizon.hessian_models import GaussNewton, hessian_end, hessian_stage, linear_stage
from fpirhc.horizon.horizon import Horizon
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking


@dataclass(frozen=True, eq=False)
class PlanGain:
    """The first gains of a plan.

    Args:
        state: K, shape (nu, nx).
        before: L, shape (nu, nu); zero unless the plan weighs the change of its inputs.
        outputs: K_d, shape (nu, ny), of the distance of measured outputs from the model's; None without outputs.
    """

    state: np.ndarray
    before: np.ndarray
    outputs: np.ndarray | None = None

    @property
    def entries(self) -> np.ndarray:
        """The entries of [K, L] by rows, shape (nu (nx + nu),)."""
        return np.hstack([self.state, self.before]).ravel()


def no_gain(plant: Plant) -> PlanGain:
    """Return the gains of a controller without a plan: zero."""
    nu = plant.input.size
    return PlanGain(np.zeros((nu, plant.state.size)), np.zeros((nu, nu)))


@dataclass(frozen=True)
class PlanFeedback(Tracking):
    """The feedback of a plan on a linear plant, whose last parameters are the entries of [K, L].

    Args:
        cycles: control cycles of one stage, after which a command is the input before; 0: the plan does not use it.
    """

    cycles: int = 0

    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, parameters, commands of one stage) -> desired."""
        del period
        target = Signal("_target", plant.state.elements, plant.state.units)
        commands = (self._commands(plant, ""),) if self.cycles else ()
        reads = (plant.state, target, plant.response_signal("nominal"), plant.parameter, *commands)
        nx, nu = plant.state.size, plant.input.size

        def step(s: Signals) -> dict[str, Expression]:
            deviation = s.state - s._target
            gains = ca.reshape(s.parameters[plant.parameter.size - nu * (nx + nu) :], nx + nu, nu).T
            planned = ca.mtimes(gains[:, :nx], deviation)
            if self.cycles:
                planned = planned + ca.mtimes(gains[:, nx:], s._commands_of_stage[-nu:])
            return {"desired": s.nominal + plant.controlled_response_function(deviation, planned, s.parameters)}

        return Block("tracking", Layout(reads), Layout((plant.response_signal("desired"),)), step)

    def update(self, plant: Plant, period: float) -> Block:
        """Block (state, desired, parameters, commands of one stage) -> these, one cycle later; the newest stands first.

        A plan's rate counts from the command without the shift by the deformation: the model's inverse of the desired response.
        """
        del period
        if not self.cycles:
            writes = Layout((scalar("_plan_followed"),))
            reads = Layout((scalar("clipped"),))
            return Block("tracking_update", reads, writes, lambda s: {"_plan_followed": 1 - s.clipped})
        keep = plant.input.size * (self.cycles - 1)

        def step(s: Signals) -> dict[str, Expression]:
            older = [s._commands_of_stage[:keep]] if keep else []
            newest = plant.inverse_function(s.state, s.desired, s.parameters)
            return {"_commands_of_stage_after": ca.vertcat(newest, *older)}

        reads = Layout((plant.state, plant.response_signal("desired"), plant.parameter, self._commands(plant, "")))
        return Block("tracking_update", reads, Layout((self._commands(plant, "_after"),)), step)

    def delays(self, plant: Plant) -> tuple[Delay, ...]:
        """The commands of one stage, where the plan uses the input before."""
        return (Delay(self._commands(plant, ""), "_commands_of_stage_after"),) if self.cycles else ()

    def _commands(self, plant: Plant, suffix: str) -> Signal:
        names = tuple(f"{i} {k}" for k in range(self.cycles) for i in plant.input.elements)
        return Signal(f"_commands_of_stage{suffix}", names, plant.input.units * self.cycles)


def plan_gains(
    problem: Problem,
    horizon: Horizon,
    cost: Cost,
    times: Sequence[float],
    believed: np.ndarray,
    states_at: Callable[[np.ndarray], np.ndarray] | None = None,
) -> list[PlanGain]:
    """Return the gains of the plans that start on the reference at these times.

    Args:
        problem: the problem.
        horizon: of the plans.
        cost: of the plans.
        times: at which the plans start.
        believed: parameters of the model, shape (np,).
        states_at: times (m,) -> states (m, nx) at which the model is linearised; None: those of the reference.
    """
    plant = problem.plant
    ends = [plant.state.elements.index(name) for name in horizon.terminal]
    horizon = replace(horizon, terminal=(), margins={})
    ocp = transcribe(plant, problem.reference, horizon, cost, Limits())
    data_of = stage_data(plant, problem.reference, horizon, cost)
    function, controlled = problem.reference.function(plant), list(plant.controlled_indices)
    stages = linear_stage(ocp), hessian_stage(ocp, GaussNewton()), hessian_end(ocp)
    nx, nu = plant.state.size, plant.input.size
    gains = []
    for time in times:
        data = np.asarray(data_of(time, believed).full())
        clock = time + horizon.step * np.arange(horizon.stages)
        nodes = np.append(clock, clock[-1] + horizon.step)
        states = data[ocp.data.slice("reference")] if states_at is None else states_at(nodes).T
        wanted = np.asarray(function.map(horizon.stages)(clock[None, :])[1].full())[controlled]
        repeated = np.repeat(believed[:, None], horizon.stages, axis=1)
        inputs = np.asarray(plant.inverse_function.map(horizon.stages)(states[:, :-1], wanted, repeated).full())
        if ocp.state.size > nx:
            states = np.vstack([states, np.hstack([inputs[:, :1], inputs])])
        first = _first_gain(stages, states, inputs, data, np.eye(ocp.state.size)[:, ends])
        gains.append(PlanGain(first[:, :nx], first[:, nx:] if ocp.state.size > nx else np.zeros((nu, nu))))
    return gains


def longer(horizon: Horizon) -> Horizon:
    """Return the horizon with twice as many stages, and its blocks repeated."""
    return replace(horizon, stages=2 * horizon.stages, blocks=2 * horizon.blocks)


def _first_gain(
    stages: tuple[ca.Function, ca.Function, ca.Function],
    states: np.ndarray,
    inputs: np.ndarray,
    data: np.ndarray,
    met: np.ndarray,
) -> np.ndarray:
    """First gain of the recursion, shape (nu, ns); `met` (ns, rows) selects the states that must be zero at the end."""
    linear, curved, end = stages
    value = np.asarray(end(states[:, -1], data[:, -1])[2].full())
    tied, pulled = met, np.zeros((met.shape[1], met.shape[1]))  # E and G
    gain, pull = np.zeros((len(inputs), len(states))), np.zeros((len(inputs), met.shape[1]))
    for k in reversed(range(inputs.shape[1])):
        at = (states[:, k], inputs[:, k], data[:, k])
        a, b = (np.asarray(m.full()) for m in linear(*at)[2:4])
        q, s, r = (np.asarray(m.full()) for m in curved(*at, np.zeros(len(states))))
        coupled = s + b.T @ value @ a
        curvature = r + b.T @ value @ b
        gain, pull = -np.linalg.solve(curvature, coupled), -np.linalg.solve(curvature, b.T @ tied)
        value = q + a.T @ value @ a + coupled.T @ gain
        pulled = pulled + (b.T @ tied).T @ pull
        tied = a.T @ tied + coupled.T @ pull
    if not met.shape[1]:
        return gain
    return gain - pull @ np.linalg.lstsq(pulled, tied.T, rcond=None)[0]
