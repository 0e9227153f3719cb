"""A plan near the reference is a feedback of the state and of the input before, u = u* + K (x - x^N) + L (u_before - u*).

K and L are the first gains of the Riccati recursion over the horizon, with the model linearised along the reference and the cost's
own second derivatives. L is zero unless the cost weighs the change of the inputs from stage to stage. Bounds are left out: near the
reference they bind nowhere. An end that must be met, C x_N = 0, enters exactly, by its multiplier,

    V_k(x) = x' P_k x / 2 + x' E_k mu + mu' G_k mu / 2,      E_N = C',  G_N = 0,      mu = -G_0^-1 E_0' x.

`PlanFeedback` is the tracking law with which a plan that restarts from the measured state enters the linear loop,

    q^Des = A^ x + B^ u + D x + E u,      u = K x + L u_before      in deviations from the reference,

D and E are zero unless the plan starts at another state than the measured one (`plan_of_outputs`). It is as if the plan were
renewed in every cycle. The input before is then the command of one stage ago: the plan limits the change of the inputs per stage
and not per cycle. The shift of the command by the deformation is no part of it.
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
from fpirhc.plant.motion import controlled_places
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking


@dataclass(frozen=True, eq=False)
class PlanStart:
    """The state at which a plan on outputs starts, near a point.

    Args:
        state: x*, shape (nx,).
        by_state: its slopes by the measured state, (nx, nx).
        by_outputs: its slopes by the measured outputs, (nx, ny).
        response: slopes of the model's response there by its state, (nu, nx).
        response_by_input: by the planned input, (nu, nu).
    """

    state: np.ndarray
    by_state: np.ndarray
    by_outputs: np.ndarray
    response: np.ndarray
    response_by_input: np.ndarray


@dataclass(frozen=True, eq=False)
class PlanGain:
    """The first gains of a plan.

    Args:
        state: K, shape (nu, nx).
        before: L, shape (nu, nu); zero unless the plan weighs the change of its inputs.
        outputs: K_d, shape (nu, ny), of the distance of measured outputs from the model's; None without outputs.
        start: where the plan starts; None: at the measured state.
        response: D, shape (nu, nx), the response of the plan's start less that of the model at the measured state; None: zero.
        response_by_input: E, shape (nu, nu); None: zero.
    """

    state: np.ndarray
    before: np.ndarray
    outputs: np.ndarray | None = None
    start: PlanStart | None = None
    response: np.ndarray | None = None
    response_by_input: np.ndarray | None = None

    @property
    def entries(self) -> np.ndarray:
        """The entries of [[K, L], [D, E]] by rows, shape (2 nu (nx + nu),)."""
        response = np.zeros_like(self.state) if self.response is None else self.response
        by_input = np.zeros_like(self.before) if self.response_by_input is None else self.response_by_input
        return np.block([[self.state, self.before], [response, by_input]]).ravel()


def gain_entries(nx: int, nu: int) -> int:
    """Return the number of entries of a plan's gains."""
    return 2 * nu * (nx + nu)


def no_gain(plant: Plant) -> PlanGain:
    """Return the gains of a controller without a plan: zero."""
    nu = plant.input.size
    return PlanGain(np.zeros((nu, plant.state.size)), np.zeros((nu, nu)))


@dataclass(frozen=True)
class PlanFeedback(Tracking):
    """The feedback of a plan on a linear plant, whose last parameters are the entries of [[K, L], [D, E]].

    Args:
        cycles: control cycles of one stage, after which a command is the input before; 0: the plan does not use it.
    """

    cycles: int = 0

    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, parameters, inputs of one stage) -> desired."""
        del period
        reads = (
            plant.state,
            self._target(plant),
            plant.response_signal("nominal"),
            plant.parameter,
            *self._kept(plant),
        )
        nu = plant.input.size

        def step(s: Signals) -> dict[str, Expression]:
            deviation, planned = s.state - s._target, self._planned(plant, s)
            response = plant.equations.controlled_response(deviation, planned, s.parameters)
            besides = ca.mtimes(_gains(plant, s)[nu:, :], ca.vertcat(deviation, planned))
            return {"desired": s.nominal + response + besides}

        return Block("tracking", Layout(reads), Layout((plant.response_signal("desired"),)), step)

    def update(self, plant: Plant, period: float) -> Block:
        """Block (state, target, parameters, inputs of one stage) -> these, one cycle later; the newest stands first.

        A plan's rate counts from the planned input: the command without the shift by the deformation.
        """
        del period
        if not self.cycles:
            writes = Layout((scalar("_plan_followed"),))
            reads = Layout((scalar("clipped"),))
            return Block("tracking_update", reads, writes, lambda s: {"_plan_followed": 1 - s.clipped})
        keep = plant.input.size * (self.cycles - 1)

        def step(s: Signals) -> dict[str, Expression]:
            older = [s._commands_of_stage[:keep]] if keep else []
            return {"_commands_of_stage_after": ca.vertcat(self._planned(plant, s), *older)}

        reads = Layout((plant.state, self._target(plant), plant.parameter, *self._kept(plant)))
        return Block("tracking_update", reads, Layout((self._commands(plant, "_after"),)), step)

    def _planned(self, plant: Plant, s: Signals) -> Expression:
        nx, nu = plant.state.size, plant.input.size
        gains = _gains(plant, s)[:nu, :]
        planned = ca.mtimes(gains[:, :nx], s.state - s._target)
        return planned + ca.mtimes(gains[:, nx:], s._commands_of_stage[-nu:]) if self.cycles else planned

    def _target(self, plant: Plant) -> Signal:
        return Signal("_target", plant.state.elements, plant.state.units)

    def _kept(self, plant: Plant) -> tuple[Signal, ...]:
        return (self._commands(plant, ""),) if self.cycles else ()

    def delays(self, plant: Plant) -> tuple[Delay, ...]:
        """The commands of one stage, where the plan uses the input before."""
        return (Delay(self._commands(plant, ""), "_commands_of_stage_after"),) if self.cycles else ()

    def _commands(self, plant: Plant, suffix: str) -> Signal:
        names = tuple(f"{i} {k}" for k in range(self.cycles) for i in plant.input.elements)
        return Signal(f"_commands_of_stage{suffix}", names, plant.input.units * self.cycles)


def _gains(plant: Plant, s: Signals) -> Expression:
    nx, nu = plant.state.size, plant.input.size
    count = gain_entries(nx, nu)
    return ca.reshape(s.parameters[plant.parameter.size - count :], nx + nu, 2 * nu).T


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
    function, controlled = problem.reference.function(plant), controlled_places(plant)
    stages = linear_stage(ocp), hessian_stage(ocp, GaussNewton()), hessian_end(ocp)
    nx, nu = plant.state.size, plant.input.size
    gains = []
    for time in times:
        data = np.asarray(data_of(time, believed).full())
        nodes = time + horizon.nodes
        clock = nodes[:-1]
        states = data[ocp.data.slice("reference")] if states_at is None else states_at(nodes).T
        wanted = np.asarray(function.map(horizon.stages)(clock[None, :])[1].full())[controlled]
        repeated = np.repeat(believed[:, None], horizon.stages, axis=1)
        inputs = np.asarray(plant.equations.inverse.map(horizon.stages)(states[:, :-1], wanted, repeated).full())
        if ocp.state.size > nx:
            states = np.vstack([states, np.hstack([inputs[:, :1], inputs])])
        first = _first_gain(stages, states, inputs, data, np.eye(ocp.state.size)[:, ends])
        gains.append(PlanGain(first[:, :nx], first[:, nx:] if ocp.state.size > nx else np.zeros((nu, nu))))
    return gains


def longer(horizon: Horizon) -> Horizon:
    """Return the horizon with twice as many stages, and its blocks repeated."""
    lengths = (*horizon.lengths, *horizon.lengths[-1:] * horizon.stages)
    return replace(horizon, stages=2 * horizon.stages, blocks=2 * horizon.blocks, lengths=lengths)


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
