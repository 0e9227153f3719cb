"""Small horizons whose solutions are known by other means, for the laws of optimisers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_are

from fpirhc.errors import CompileError, InvalidProblem, NotSupported
from fpirhc.horizon.cost import LQRTerminal, Quadratic
from fpirhc.horizon.horizon import Horizon
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.base import Optimiser
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.status import Status
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import native
from fpirhc.task.exogenous import previewed_values
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory

Array = npt.NDArray[Any]
Posed: TypeAlias = tuple[OptimalControl, Array, Array]


def posed(problem: Problem, *, time: float = 0.0, parameters: Array | None = None) -> Posed:
    """Return (ocp, s_0, data) of a problem's horizon at a time, for `solve(ocp, optimiser, s_0, data)`.

    s_0, shape (ns,), is the stages' state at the problem's start; data, shape (ntheta, N + 1), have the approximate parameters
    unless others are given.
    """
    horizon, cost = problem.horizon, problem.cost
    if horizon is None or cost is None:
        raise InvalidProblem("nothing is planned without a horizon and a cost: give the problem both")
    parts, ahead = (problem.plant, problem.reference, horizon, cost), previewed_values(problem.plant, problem.signals)
    ocp = transcribe(*parts, problem.limits, ahead, problem.start_state)
    data = stage_data(*parts, signals=ahead)(time, problem.plant.approximate if parameters is None else parameters)
    return ocp, np.asarray(ocp.start(problem.start_state, problem.inputs_before).full()).ravel(), data.full()


def compiled(function: ca.Function, flags: Sequence[str] = ()) -> ca.Function:
    """Return a Function in C as a run has it, an optimiser's step with its own loops; CompileError: no compiler, or it failed."""
    made = native(function, flags, required=True)
    if not made.compiled:
        raise CompileError(made.reason)
    return made.function


STAGES, STEP = 6, 0.3  # s; a short horizon of a mild cost, so that plain gradient methods converge too
BOUND = 0.4  # N; plans without bounds need about twice as much
CORRIDOR = 0.2  # m, of the state
_WEIGHTS = {"y": 2.0, "y'": 0.5}
_EFFORT = 1.0


@dataclass(frozen=True, eq=False)
class Trial:
    """An optimiser with the horizons of its laws."""

    optimiser: Optimiser
    tolerance: float  # stationarity below which it calls a plan OK
    calls: int  # calls within which it must solve a small problem

    def _task(self, nonlinearity: float, **limits: dict[str, tuple[float, float]]) -> TrialHorizon:
        return TrialHorizon(self.optimiser, self.calls, _oscillator(nonlinearity), Limits(**limits))  # type: ignore[arg-type]

    @cached_property
    def linear(self) -> TrialHorizon:
        """A linear model without limits."""
        return self._task(0.0)

    @cached_property
    def bounded(self) -> TrialHorizon:
        """A linear model with limits of the input that bind."""
        return self._task(0.0, inputs={"u": (-BOUND, BOUND)})

    @cached_property
    def nonlinear(self) -> TrialHorizon:
        """A nonlinear model without limits."""
        return self._task(1.0)

    @cached_property
    def impossible(self) -> TrialHorizon:
        """A limit that no input can keep in the first stages."""
        return self._task(0.0, inputs={"u": (-BOUND, BOUND)}, states={"y": (-CORRIDOR, CORRIDOR)})


class TrialPlan(NamedTuple):
    """The result of the last of some calls."""

    state: Array  # first state
    inputs: Array  # inputs of the plan
    diagnostics: Array  # the five numbers of the optimiser
    memory: Array  # memory after the call
    calls: int  # number of calls

    @property
    def cost(self) -> float:
        """Cost of the plan, by the optimiser."""
        return float(self.diagnostics[0])

    @property
    def stationarity(self) -> float:
        """Stationarity of the plan, by the optimiser."""
        return float(self.diagnostics[1])

    @property
    def status(self) -> Status:
        """Status of the plan, by the optimiser."""
        return Status(int(self.diagnostics[4]))


@dataclass(frozen=True, eq=False)
class TrialHorizon:
    """One horizon with its data, the functions of an optimiser for it, and its solution by other means."""

    optimiser: Optimiser
    calls: int  # calls within which it must solve the horizon
    plant: Plant
    limits: Limits

    @cached_property
    def served(self) -> bool:
        """Whether the optimiser can serve the problem; it may refuse one."""
        try:
            self.optimiser.check(self.ocp)
        except NotSupported:
            return False
        return True

    @cached_property
    def layout(self) -> Layout:
        """Memory of the optimiser."""
        return self.optimiser.memory(self.ocp)

    @cached_property
    def step(self) -> ca.Function:
        """One call, as in a control loop."""
        return self.optimiser.step(self.ocp)

    @cached_property
    def converging(self) -> ca.Function:
        """One call of an open-loop solve."""
        return self.optimiser.converging(self.ocp)

    @cached_property
    def shifted(self) -> ca.Function:
        """The memory one stage later."""
        memory = ca.MX.sym("memory", self.layout.size)
        return ca.Function("shifted", [memory], [ca.densify(ca.MX(self.optimiser.shifted(self.ocp, memory)))])

    def begun(self, plan: Array) -> Array:
        """The memory of a run that begins with a plan."""
        memory = self.layout.start()
        memory[self.layout.slice("plan_inputs")] = plan
        return memory

    def called(self, state: Array, memory: Array, data: Array | None = None) -> TrialPlan:
        """One call of the step, as in a control loop."""
        return self._answer(self.step, state, memory, self.data if data is None else data, 1)

    def solved(self, state: Array, memory: Array | None = None, most: int | None = None) -> TrialPlan:
        """Calls of the converging step until the status is OK, at most `most` or else `calls` of them."""
        answer = self._answer(self.converging, state, self.layout.start() if memory is None else memory, self.data, 1)
        while answer.status in (Status.NOT_CONVERGED, Status.INFEASIBLE) and answer.calls < (most or self.calls):
            answer = self._answer(self.converging, state, answer.memory, self.data, answer.calls + 1)
        return answer

    def _answer(self, step: ca.Function, state: Array, memory: Array, data: Array, calls: int) -> TrialPlan:
        results = step(state, data, self.ocp.input_lower, self.ocp.input_upper, memory)
        inputs, diagnostics, next_memory = (np.asarray(v.full()) for v in results)
        return TrialPlan(state, inputs, diagnostics[:, 0], next_memory[:, 0], calls)

    @cached_property
    def _posed(self) -> Posed:
        """Squares of state and input, ended by the Riccati equation's weight."""
        horizon, rest = Horizon(STAGES, STEP), Trajectory(lambda t: {"y": 0 * t})
        cost = Quadratic(states=_WEIGHTS, effort={"u": _EFFORT}, terminal=LQRTerminal())
        return posed(Problem(self.plant, rest, {"y": 0.0}, STEP, STEP, limits=self.limits, horizon=horizon, cost=cost))

    @property
    def ocp(self) -> OptimalControl:
        """The horizon in standard form."""
        return self._posed[0]

    @property
    def data(self) -> Array:
        """Data of the stages."""
        return self._posed[2]

    @cached_property
    def model(self) -> tuple[Array, Array]:
        """A and B of one stage around rest."""
        s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
        next_state = self.ocp.dynamics(s, u, self.data[:, 0])
        slopes = ca.Function("slopes", [s, u], [ca.jacobian(next_state, s), ca.jacobian(next_state, u)])
        a, b = slopes(np.zeros(2), 0.0)
        return np.asarray(a.full()), np.asarray(b.full())

    @cached_property
    def weights(self) -> tuple[Array, Array, Array]:
        """Q and R of one stage, and P by scipy's Riccati equation."""
        q, r = STEP * np.diag(list(_WEIGHTS.values())), STEP * np.array([[_EFFORT]])
        return q, r, np.asarray(solve_discrete_are(*self.model, q, r))

    @cached_property
    def squares(self) -> tuple[Array, Array]:
        """F and G with V = |F U + G s_0|^2: the linear horizon written as one sum of squares."""
        (a, b), (q, r, p) = self.model, self.weights
        rows_u, rows_s = [np.kron(np.eye(STAGES), np.linalg.cholesky(r).T)], [np.zeros((STAGES, 2))]
        by_u, by_s = np.zeros((2, STAGES)), np.eye(2)
        for stage in range(1, STAGES + 1):
            by_u, by_s = a @ by_u, a @ by_s
            by_u[:, stage - 1] += b[:, 0]
            root = np.linalg.cholesky(p if stage == STAGES else q).T
            rows_u.append(root @ by_u)
            rows_s.append(root @ by_s)
        return np.vstack(rows_u), np.vstack(rows_s)

    @cached_property
    def reach(self) -> float:
        """Largest error of an input per unit of stationarity: |H^-1 D^-1| in the largest row sum."""
        hessian = 2 * self.squares[0].T @ self.squares[0]
        scale = STEP * self.ocp.curvature[0]
        return float(np.abs(np.linalg.inv(hessian)).sum(axis=1).max() * scale)

    def states(self, state: Array, inputs: Array) -> list[Array]:
        """s_0 ... s_N by simulation of the model, stage by stage."""
        states = [state]
        for stage in range(STAGES):
            next_state = self.ocp.dynamics(states[-1], inputs[:, stage], self.data[:, stage])
            states.append(np.asarray(next_state.full())[:, 0])
        return states

    def value(self, state: Array, inputs: Array) -> float:
        """V of these inputs."""
        *states, last = self.states(state, inputs)
        stages = [float(self.ocp.stage_cost(s, inputs[:, k], self.data[:, k])[0]) for k, s in enumerate(states)]
        return sum(stages) + float(self.ocp.terminal_cost(last, self.data[:, STAGES]))

    def residual(self, state: Array, inputs: Array) -> float:
        """Stationarity of a plan by central differences of V."""
        step, slope = 1e-4, np.zeros_like(inputs)
        for stage in range(STAGES):
            ends = [self.value(state, inputs + side * step * (np.arange(STAGES) == stage)) for side in (1, -1)]
            slope[0, stage] = (ends[0] - ends[1]) / (2 * step)
        move = slope / (STEP * self.ocp.curvature[0])
        return float(np.abs(inputs - np.clip(inputs - move, self.ocp.input_lower, self.ocp.input_upper)).max())


def _oscillator(nonlinearity: float) -> Plant:
    """The plant y'' = u - y / 2 - y' / 10 - nonlinearity sin(2 y) / 2."""
    return Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"k": Parameter(0.5, 0.5, "1/s^2"), "nonlinearity": Parameter(nonlinearity, nonlinearity, "m/s^2")},
        response=lambda q, v, u, p: {"y": u.u - p.k * q.y - 0.1 * v.y - 0.5 * p.nonlinearity * ca.sin(2 * q.y)},
    )
