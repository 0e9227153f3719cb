"""Laws that every optimiser keeps, tried on small horizons whose answers are known by other means."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_are
from scipy.optimize import lsq_linear

from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.horizon.cost import LqrTerminal, Quadratic
from fpirhc.horizon.problem import Horizon, OptimalControl, stage_data, transcribe
from fpirhc.limits import Limits
from fpirhc.optimisers.base import FEASIBLE, Optimiser
from fpirhc.plant import Parameter, Plant
from fpirhc.reference import Trajectory
from fpirhc.status import Status
from fpirhc.symbolic.layout import Layout
from fpirhc.testing.laws import hold, is_a_frozen_value, keep, within

Array = npt.NDArray[Any]

_STAGES, _STEP = 6, 0.3  # s; a short horizon of a mild cost, so that plain gradient methods converge too
_WEIGHTS = {"y": 2.0, "y'": 0.5}
_EFFORT = 1.0
_BOUND = 0.4  # N; the free plans ask for about twice as much
_CORRIDOR = 0.2  # m, of the state
_SLACK = 2.0  # times the tolerance that a claimed stationarity may be off
_DIFFERENCE = 1e-6  # relative error of central differences of a cost
_TRIALS = 3
_FEW = 5  # calls that a problem without solution is given


def check_optimiser(optimiser: Optimiser, *, tolerance: float, seed: int, calls: int = 50) -> None:
    """Check every law on an optimiser.

    Parameters:
        tolerance: of the stationarity, in the unit of the inputs, below which it calls a plan OK.
        seed: draws first states and plans. calls: of its step, within which it must solve a small convex problem.

    Raises:
        AssertionError: the first law that does not hold, in one sentence.
        InvalidValue: a tolerance that is not positive, or above 1e-3: too coarse to tell a solution by.
    """
    if not 0 < tolerance <= 1e-3:
        raise InvalidValue(f"check_optimiser(tolerance={tolerance!r}): expected a number above 0 and up to 1e-3")
    keep(optimiser, _Trial(optimiser, tolerance, calls), LAWS, seed)


@dataclass(frozen=True, eq=False)
class _Trial:
    """An optimiser with the horizons that it is tried on."""

    optimiser: Optimiser
    tolerance: float
    calls: int

    @cached_property
    def linear(self) -> _Task:
        return self._task(0.0, Limits())

    @cached_property
    def bounded(self) -> _Task:
        return self._task(0.0, Limits(inputs={"u": (-_BOUND, _BOUND)}))

    @cached_property
    def bent(self) -> _Task:
        return self._task(1.0, Limits())

    @cached_property
    def impossible(self) -> _Task:
        """A limit that no input can keep in the first stages."""
        return self._task(0.0, Limits(inputs={"u": (-_BOUND, _BOUND)}, states={"y": (-_CORRIDOR, _CORRIDOR)}))

    def _task(self, bent: float, limits: Limits) -> _Task:
        return _Task(self.optimiser, self.calls, _oscillator(bent), limits)


@dataclass(frozen=True, eq=False)
class _Answer:
    """What the last of some calls gave."""

    state: Array
    inputs: Array
    diagnostics: Array
    memory: Array
    calls: int

    @property
    def cost(self) -> float:
        return float(self.diagnostics[0])

    @property
    def stationarity(self) -> float:
        return float(self.diagnostics[1])

    @property
    def status(self) -> Status:
        return Status(int(self.diagnostics[4]))


@dataclass(frozen=True, eq=False)
class _Task:
    """One horizon with its data, what an optimiser makes of it, and what is known about it."""

    optimiser: Optimiser
    calls: int
    plant: Plant
    limits: Limits

    @cached_property
    def served(self) -> bool:
        """Whether the optimiser takes the problem; to refuse one is honest."""
        try:
            self.optimiser.check(self.ocp)
        except NotSupported:
            return False
        return True

    @cached_property
    def layout(self) -> Layout:
        return self.optimiser.memory(self.ocp)

    @cached_property
    def step(self) -> ca.Function:
        return self.optimiser.step(self.ocp)

    @cached_property
    def converging(self) -> ca.Function:
        return self.optimiser.converging(self.ocp)

    @cached_property
    def shifted(self) -> ca.Function:
        memory = ca.MX.sym("memory", self.layout.size)
        return ca.Function("shifted", [memory], [ca.densify(ca.MX(self.optimiser.shifted(self.ocp, memory)))])

    def begun(self, plan: Array) -> Array:
        """The memory of a run that begins with a plan."""
        memory = self.layout.start()
        memory[self.layout.slice("plan_inputs")] = plan
        return memory

    def called(self, state: Array, memory: Array, data: Array | None = None) -> _Answer:
        """One call of the step, as in a control loop."""
        return self._answer(self.step, state, memory, self.data if data is None else data, 1)

    def solved(self, state: Array, memory: Array | None = None, most: int | None = None) -> _Answer:
        """Calls of the converging step until the status is OK, at most `most` where that is given."""
        answer = self._answer(self.converging, state, self.layout.start() if memory is None else memory, self.data, 1)
        while answer.status in (Status.NOT_CONVERGED, Status.INFEASIBLE) and answer.calls < (most or self.calls):
            answer = self._answer(self.converging, state, answer.memory, self.data, answer.calls + 1)
        return answer

    def _answer(self, step: ca.Function, state: Array, memory: Array, data: Array, calls: int) -> _Answer:
        given = step(state, data, self.ocp.input_lower, self.ocp.input_upper, memory)
        inputs, said, following = (np.asarray(v.full()) for v in given)
        return _Answer(state, inputs, said[:, 0], following[:, 0], calls)

    @cached_property
    def cost(self) -> Quadratic:
        return Quadratic(states=_WEIGHTS, effort={"u": _EFFORT}, terminal_cost=LqrTerminal())

    @cached_property
    def ocp(self) -> OptimalControl:
        return transcribe(self.plant, _REST, Horizon(_STAGES, _STEP), self.cost, self.limits)

    @cached_property
    def data(self) -> Array:
        found = stage_data(self.plant, _REST, Horizon(_STAGES, _STEP), self.cost)(0.0, self.plant.approximate)
        return np.asarray(found.full())

    @cached_property
    def model(self) -> tuple[Array, Array]:
        """A and B of one stage around rest."""
        s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
        following = self.ocp.dynamics(s, u, self.data[:, 0])
        slopes = ca.Function("slopes", [s, u], [ca.jacobian(following, s), ca.jacobian(following, u)])
        a, b = slopes(np.zeros(2), 0.0)
        return np.asarray(a.full()), np.asarray(b.full())

    @cached_property
    def weights(self) -> tuple[Array, Array, Array]:
        """Q and R of one stage, and P by scipy's Riccati equation."""
        q, r = _STEP * np.diag(list(_WEIGHTS.values())), _STEP * np.array([[_EFFORT]])
        return q, r, np.asarray(solve_discrete_are(*self.model, q, r))

    @cached_property
    def squares(self) -> tuple[Array, Array]:
        """F and G with V = |F U + G s_0|^2: the linear horizon written as one sum of squares."""
        (a, b), (q, r, p) = self.model, self.weights
        rows_u, rows_s = [np.kron(np.eye(_STAGES), np.linalg.cholesky(r).T)], [np.zeros((_STAGES, 2))]
        by_u, by_s = np.zeros((2, _STAGES)), np.eye(2)
        for stage in range(1, _STAGES + 1):
            by_u, by_s = a @ by_u, a @ by_s
            by_u[:, stage - 1] += b[:, 0]
            root = np.linalg.cholesky(p if stage == _STAGES else q).T
            rows_u.append(root @ by_u)
            rows_s.append(root @ by_s)
        return np.vstack(rows_u), np.vstack(rows_s)

    @cached_property
    def reach(self) -> float:
        """By how much an input may be off, at most, per unit of stationarity: |H^-1 D^-1| in the largest row sum."""
        hessian = 2 * self.squares[0].T @ self.squares[0]
        scale = _STEP * self.ocp.curvature[0]
        return float(np.abs(np.linalg.inv(hessian)).sum(axis=1).max() * scale)

    def states(self, state: Array, inputs: Array) -> list[Array]:
        """s_0 ... s_N by rolling the model out in numbers, stage by stage."""
        found = [state]
        for stage in range(_STAGES):
            following = self.ocp.dynamics(found[-1], inputs[:, stage], self.data[:, stage])
            found.append(np.asarray(following.full())[:, 0])
        return found

    def value(self, state: Array, inputs: Array) -> float:
        """V of these inputs."""
        *states, last = self.states(state, inputs)
        stages = [float(self.ocp.stage_cost(s, inputs[:, k], self.data[:, k])[0]) for k, s in enumerate(states)]
        return sum(stages) + float(self.ocp.terminal_cost(last, self.data[:, _STAGES]))

    def residual(self, state: Array, inputs: Array) -> float:
        """Stationarity of a plan by central differences of V."""
        step, slope = 1e-4, np.zeros_like(inputs)
        for stage in range(_STAGES):
            ends = [self.value(state, inputs + side * step * (np.arange(_STAGES) == stage)) for side in (1, -1)]
            slope[0, stage] = (ends[0] - ends[1]) / (2 * step)
        move = slope / (_STEP * self.ocp.curvature[0])
        return float(np.abs(inputs - np.clip(inputs - move, self.ocp.input_lower, self.ocp.input_upper)).max())


_REST = Trajectory(lambda t: {"y": 0 * t})


def _oscillator(bent: float) -> Plant:
    """The plant y'' = u - y / 2 - y' / 10 - bent sin(2 y) / 2."""
    return Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"k": Parameter(0.5, 0.5, "1/s^2"), "bent": Parameter(bent, bent, "m/s^2")},
        response=lambda q, v, u, p: {"y": u.u - p.k * q.y - 0.1 * v.y - 0.5 * p.bent * ca.sin(2 * q.y)},
    )


def frozen_value(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """An optimiser is a frozen value that can be hashed, copied and described."""
    is_a_frozen_value(trial.optimiser)


def remembers_a_plan(trial: _Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """The memory holds the plan in `plan_inputs`, and step and shift keep its size."""
    task = trial.linear
    layout = task.layout
    hold("plan_inputs" in layout, f"memory() lays out {list(layout.names)}, but not 'plan_inputs'")
    size = layout["plan_inputs"].size
    hold(size == _STAGES, f"'plan_inputs' has {size} entries, expected {_STAGES}: inputs times stages")
    shapes = [task.step.size_out(k) for k in range(task.step.n_out())]
    expected = [(1, _STAGES), (5, 1), (layout.size, 1)]
    hold(shapes == expected, f"step gives {shapes}, expected {expected}: plan, diagnostics, memory")
    size = task.shifted.numel_out(0)
    hold(size == layout.size, f"shifted() gives {size} entries, the memory has {layout.size}")


def linear_plan_is_riccati(trial: _Trial, generator: np.random.Generator) -> None:
    """On a linear model with a quadratic cost the plan is u_i = -K s_i with K of scipy's Riccati equation."""
    task = trial.linear
    (a, b), (_, r, p) = task.model, task.weights
    gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    for _ in range(_TRIALS):
        found = task.solved(generator.normal(size=2))
        hold(
            found.status == Status.OK,
            f"on {_STAGES} stages of a linear model its status after {found.calls} calls is {found.status.name}, stationarity "
            f"{found.stationarity:.3g}; give more iterations or calls",
        )
        s, expected = found.state, []
        for _ in range(_STAGES):
            expected.append(-float((gain @ s)[0]))
            s = a @ s + b[:, 0] * expected[-1]
        missed = float(np.abs(found.inputs[0] - expected).max())
        allowed = _SLACK * task.reach * trial.tolerance + 1e-9
        hold(
            within(missed, allowed), f"an input of its plan is off by {missed:.3g}, the tolerance allows {allowed:.3g}"
        )


def plan_is_stationary(trial: _Trial, generator: np.random.Generator) -> None:
    """On a nonlinear model a plan called OK is stationary by central differences, and costs what it says."""
    for _ in range(_TRIALS):
        found = trial.bent.solved(generator.normal(size=2))
        _judged(trial, trial.bent, found)
        hold(found.status == Status.OK, f"after {found.calls} calls its status is {found.status.name}")


def _judged(trial: _Trial, task: _Task, found: _Answer) -> None:
    """Compare what is said about a plan with what it is."""
    cost, residual = task.value(found.state, found.inputs), task.residual(found.state, found.inputs)
    hold(
        within(found.cost - cost, 1e-9 * (1 + abs(cost))),
        f"it says the plan costs {found.cost:.9g}, rolled out it costs {cost:.9g}",
    )
    allowed = _SLACK * trial.tolerance + _DIFFERENCE * (1 + cost)
    hold(
        found.status != Status.OK or residual <= allowed,
        f"it calls a plan OK whose stationarity by central differences is {residual:.3g}, above {trial.tolerance:g}",
    )
    hold(
        within(found.stationarity - residual, allowed + 0.01 * residual),
        f"it says stationarity {found.stationarity:.3g}, central differences give {residual:.3g}",
    )


def status_is_honest(trial: _Trial, generator: np.random.Generator) -> None:
    """One call from a bad first plan says OK only if the plan is converged, and the truth about it otherwise."""
    task = trial.bent
    for _ in range(_TRIALS):
        found = task.called(3 * generator.normal(size=2), task.begun(3 * generator.normal(size=_STAGES)))
        if found.status in (Status.OK, Status.NOT_CONVERGED):
            _judged(trial, task, found)
        hold(
            found.status != Status.NOT_CONVERGED or found.stationarity > trial.tolerance * (1 - 1e-9),
            f"it says not converged at stationarity {found.stationarity:.3g}, which is within {trial.tolerance:g}",
        )


def bounds_of_inputs_are_kept(trial: _Trial, generator: np.random.Generator) -> None:
    """No input of any plan leaves its bounds, and the bounded plan is scipy's least-squares solution; or bounds are refused."""
    task = trial.bounded
    if not task.served:
        return
    by_u, by_s = task.squares
    for size in (1.0, 3.0, 10.0):
        found = task.solved(size * generator.normal(size=2))
        outside = float(np.abs(found.inputs).max()) - _BOUND
        hold(outside <= 1e-9, f"an input is {outside:.3g} outside its bounds of {_BOUND:g}")
        said = f"{found.status.name} after {found.calls} calls"
        hold(found.status == Status.OK, f"with active bounds its status is {said}")
        best = lsq_linear(by_u, -by_s @ found.state, (-_BOUND, _BOUND), tol=1e-14, method="bvls").x
        missed = float(np.abs(found.inputs[0] - best).max())
        # Inputs at a bound leave fewer free ones, whose Hessian may be worse than the whole.
        allowed = 10 * _SLACK * task.reach * trial.tolerance + 1e-7
        hold(within(missed, allowed), f"with active bounds an input is off by {missed:.3g}, allowed is {allowed:.3g}")


def bounds_of_a_call_count(trial: _Trial, generator: np.random.Generator) -> None:
    """The bounds are those given to the call, from the first call on, not those of the problem."""
    task = trial.bounded
    if not task.served:
        return
    lower, upper = -0.5 * _BOUND, 0.1 * _BOUND
    memory = task.begun(generator.normal(size=_STAGES))
    inputs = np.asarray(task.step(3 * generator.normal(size=2), task.data, lower, upper, memory)[0].full())
    worst = float(np.maximum(lower - inputs, inputs - upper).max())
    hold(worst <= 1e-9, f"given bounds ({lower:g}, {upper:g}), it plans an input {worst:.3g} outside of them")


def infeasible_is_told(trial: _Trial, generator: np.random.Generator) -> None:
    """A limit of a state that cannot be kept is never called OK; or limits of states are refused."""
    task = trial.impossible
    if not task.served:
        return
    found = task.solved(np.array([2.0, float(generator.uniform(1.0, 2.0))]), most=_FEW)
    worst = max(float(np.abs(s[0])) for s in task.states(found.state, found.inputs)[1:]) - _CORRIDOR
    hold(found.status != Status.OK, f"it calls a plan OK that violates a limit of a state by {worst:.3g}")
    said = float(found.diagnostics[2])
    hold(
        found.status == Status.NON_FINITE or within(said - worst, FEASIBLE),
        f"it says a limit is violated by {said:.3g}, rolled out it is {worst:.3g}",
    )


def nan_is_told(trial: _Trial, generator: np.random.Generator) -> None:
    """A state or data that are not numbers give status NON_FINITE and a finite plan, and nothing of it is remembered."""
    task = trial.linear
    state = generator.normal(size=2)
    memory = task.begun(task.solved(state).inputs[0])
    spoilt = task.data.copy()
    spoilt[task.ocp.data.slice("reference"), _STAGES // 2] = np.nan
    cases = {
        "a state of NaN": (np.array([np.nan, 0.0]), task.data),
        "an infinite state": (np.array([0.0, np.inf]), task.data),
        "a reference of NaN": (state, spoilt),
    }
    for what, (first, data) in cases.items():
        found = task.called(first, memory, data)
        hold(found.status == Status.NON_FINITE, f"given {what}, its status is {found.status.name}, expected NON_FINITE")
        hold(bool(np.isfinite(found.inputs).all()), f"given {what}, it plans {found.inputs[0]}")
        hold(bool(np.isfinite(found.memory).all()), f"given {what}, it remembers values that are not finite")
        after = task.solved(state, found.memory).status
        hold(after == Status.OK, f"after {what} it does not recover: its status is {after.name}")


def poisoned_memory_is_forgotten(trial: _Trial, generator: np.random.Generator) -> None:
    """A memory that is not finite does not stay so: the next calls solve the problem."""
    task = trial.linear
    after = task.solved(generator.normal(size=2), np.full(task.layout.size, np.nan))
    hold(after.status == Status.OK, f"from a memory of NaN its status after {after.calls} calls is {after.status.name}")
    hold(bool(np.isfinite(after.memory).all()), "from a memory of NaN it solves the problem, but remembers NaN still")


def solution_stays(trial: _Trial, generator: np.random.Generator) -> None:
    """Called once more at a solution, it stays there and says OK; one stage later the shifted plan serves as well."""
    task = trial.linear
    (a, b), state = task.model, generator.normal(size=2)
    solved = task.solved(state)
    again = task.called(state, solved.memory)
    moved = float(np.abs(again.inputs - solved.inputs).max())
    allowed = 2 * _SLACK * task.reach * trial.tolerance + 1e-9
    hold(
        within(moved, allowed), f"called again at a solution it moves the plan by {moved:.3g}, allowed is {allowed:.3g}"
    )
    hold(again.status == Status.OK, f"called again at a solution its status is {again.status.name}")
    shifted = np.asarray(task.shifted(again.memory).full())[:, 0]
    kept = shifted[task.layout.slice("plan_inputs")][:-1]
    missed = float(np.abs(kept - again.inputs[0, 1:]).max())
    hold(
        within(missed, allowed),
        f"shifted() changes inputs of the plan by {missed:.3g} besides dropping the first stage",
    )
    later = task.solved(a @ state + b[:, 0] * again.inputs[0, 0], shifted)
    hold(later.status == Status.OK, f"from the shifted plan of the stage before its status is {later.status.name}")


LAWS = (
    frozen_value,
    remembers_a_plan,
    linear_plan_is_riccati,
    plan_is_stationary,
    status_is_honest,
    bounds_of_inputs_are_kept,
    bounds_of_a_call_count,
    infeasible_is_told,
    nan_is_told,
    poisoned_memory_is_forgotten,
    solution_stays,
)
