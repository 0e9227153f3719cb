"""Laws that every optimiser keeps, tried on small convex horizons and one that is not: a simulation judges the plans."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.conformance.laws import Array, Broken, Draw, keep, within
from fpirhc.errors import CompileError, InvalidProblem, NotSupported
from fpirhc.fields.checked import checked_call, replaced
from fpirhc.fields.kinds import Range, Seed
from fpirhc.horizon.cost import Horizon, LQRTerminal, Quadratic
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers import FEASIBLE, UNKNOWN_ITERATIONS, Optimiser, worked
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.status import Status
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import native
from fpirhc.task.exogenous import model_values
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory

Posed: TypeAlias = tuple[OptimalControl, Array, Array]

_CALLS, _FEW = 50, 5  # of the step within which it must solve a small convex problem; on a problem without solution
_STAGES, _STEP = 6, 0.3  # s; a short horizon of a mild cost, so that plain gradient methods converge too
_BOUND = 0.4  # N; plans without bounds need about twice as much
_CORRIDOR = 0.2  # m, of the state
_SLACK = 2.0  # allowed error of a stationarity, in tolerances
_REACH = 5.0  # largest error of an input of these horizons per unit of stationarity
_DIFFERENCE = 1e-6  # relative error of central differences of a cost
_FAR = 1e6  # size of a state from which no plan is converged after a few iterations
_SOLVERS = ("Nlpsol", "Conic", "Rootfinder", "Integrator", "External", "CallbackInternal")


def posed(problem: Problem, *, time: float = 0.0, parameters: Array | None = None) -> Posed:
    """Return (ocp, s_0, data) of a problem's horizon at a time, for `solve(ocp, optimiser, s_0, data)`.

    s_0, shape (ns,), is the stages' state at the problem's start; data, shape (ntheta, N + 1), have the approximate parameters
    unless others are given.
    """
    horizon, cost = problem.horizon, problem.cost
    if horizon is None or cost is None:
        raise InvalidProblem("nothing is planned without a horizon and a cost: give the problem both")
    plant, ahead = problem.plant, model_values(problem.plant, problem.signals)
    ocp = transcribe(plant, problem.reference, horizon, cost, problem.limits, ahead, problem.start_state)
    data = ocp.data_of()(time, plant.approximate if parameters is None else parameters)
    return ocp, np.asarray(ocp.start(problem.start_state, problem.inputs_before).full()).ravel(), data.full()


def compiled(function: ca.Function, flags: Sequence[str] = ()) -> ca.Function:
    """Return a Function in C as a run has it, an optimiser's step with its own loops; CompileError: no compiler, or it failed."""
    made = native(function, flags, required=True)
    if not made.compiled:
        raise CompileError(made.reason)
    return made.function


@checked_call
def check_optimiser(
    optimiser: Optimiser,
    *,
    tolerance: Annotated[float, Range("a number above 0 and up to 1e-3", lambda v: 0 < v <= 1e-3)],
    seed: Seed,
) -> None:
    """Check every law on an optimiser.

    Args:
        tolerance: stationarity, in the unit of the inputs, below which it calls a plan OK.
    """
    keep(_Trial(optimiser, tolerance), seed)


class _Plan(NamedTuple):
    """The result of the last of some calls."""

    state: Array  # first state
    inputs: Array
    diagnostics: Array
    memory: Array  # after the call

    @property
    def status(self) -> Status:
        return Status(int(self.diagnostics[4]))


@dataclass(frozen=True, eq=False)
class _Horizon:
    """A horizon with an optimiser's functions for it."""

    optimiser: Optimiser
    ocp: OptimalControl
    data: Array

    @classmethod
    def of(cls, optimiser: Optimiser, nonlinearity: float, limits: Limits) -> _Horizon:
        """That of the plant y'' = u - y / 2 - y' / 10 - nonlinearity sin(2 y) / 2."""
        plant = Plant(
            coordinates={"y": "m"},
            inputs={"u": "N"},
            parameters={"n": Parameter(nonlinearity, nonlinearity, "m/s^2")},
            response=lambda q, v, u, p: {"y": u.u - 0.5 * q.y - 0.1 * v.y - 0.5 * p.n * ca.sin(2 * q.y)},
        )
        horizon, rest = Horizon(_STAGES, _STEP), Trajectory(lambda t: {"y": 0 * t})
        cost = Quadratic(states={"y": 2.0, "y'": 0.5}, effort={"u": 1.0}, terminal=LQRTerminal())
        problem = Problem(plant, rest, {"y": 0.0}, _STEP, _STEP, limits=limits, horizon=horizon, cost=cost)
        ocp, _, data = posed(problem)
        return cls(optimiser, ocp, data)

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
        return self.optimiser.memory(self.ocp)

    @cached_property
    def step(self) -> ca.Function:
        return self.optimiser.step(self.ocp)

    def shifted(self, memory: Array) -> Array:
        """The memory one stage later."""
        later = self.optimiser.shifted(self.ocp, ca.MX(ca.DM(memory)))
        return np.asarray(ca.evalf(ca.densify(later)).full())[:, 0]

    def begun(self, plan: Array) -> Array:
        """The memory of a run that begins with a plan."""
        memory = self.layout.start()
        memory[self.layout.slice("plan_inputs")] = plan
        return memory

    def called(self, state: Array, memory: Array | None = None, **given: Any) -> _Plan:
        """One call of the step, as in a control loop; `given`: other data, lower or upper bounds."""
        known = {"data": self.data, "lower": self.ocp.input_lower, "upper": self.ocp.input_upper} | given
        before = self.layout.start() if memory is None else memory
        inputs, numbers, after = (np.asarray(v.full()) for v in self.step(state, *known.values(), before))
        return _Plan(state, inputs, numbers[:, 0], after[:, 0])

    def solved(self, state: Array, memory: Array | None = None, most: int = _CALLS) -> _Plan:
        """Calls of an open-loop solve until the status is OK, at most so many."""
        given, before = (state, self.data, self.ocp.input_lower, self.ocp.input_upper), memory
        before = self.layout.start() if before is None else before
        for _ in range(most):
            inputs, numbers, after = worked(self.optimiser, self.ocp, (*given, before))
            plan = _Plan(state, inputs, numbers[:, 0], after[:, 0])
            if plan.status not in (Status.NOT_CONVERGED, Status.INFEASIBLE):
                break
            before = plan.memory
        return plan

    def states(self, state: Array, inputs: Array) -> list[Array]:
        """s_0 ... s_N by simulation of the model, stage by stage."""
        states = [state]
        for stage in range(_STAGES):
            next_state = self.ocp.dynamics(states[-1], inputs[:, stage], self.data[:, stage])
            states.append(np.asarray(next_state.full())[:, 0])
        return states

    def cost(self, state: Array, inputs: Array) -> float:
        """V of these inputs."""
        *states, last = self.states(state, inputs)
        stages = [float(self.ocp.stage_cost(s, inputs[:, k], self.data[:, k])[0]) for k, s in enumerate(states)]
        return sum(stages) + float(self.ocp.terminal_cost(last, self.data[:, _STAGES]))

    def residual(self, state: Array, inputs: Array) -> float:
        """Stationarity of a plan by central differences of V."""
        step = 1e-4 * max(1.0, float(np.abs(state).max()))
        moves = step * np.eye(_STAGES)[:, None, :]
        rises = [self.cost(state, inputs + move) - self.cost(state, inputs - move) for move in moves]
        moved = inputs - np.array(rises) / (2 * step) / (_STEP * self.ocp.curvature[0])
        return float(np.abs(inputs - np.clip(moved, self.ocp.input_lower, self.ocp.input_upper)).max())


@dataclass(frozen=True, eq=False)
class _Trial:
    """An optimiser with the horizons of its laws."""

    optimiser: Optimiser
    tolerance: float  # stationarity below which it calls a plan OK

    @cached_property
    def linear(self) -> _Horizon:
        """A linear model without limits."""
        return _Horizon.of(self.optimiser, 0.0, Limits())

    @cached_property
    def bounded(self) -> _Horizon:
        """The linear model with limits of the input that bind."""
        return _Horizon.of(self.optimiser, 0.0, Limits(inputs={"u": (-_BOUND, _BOUND)}))


def remembers_a_plan(trial: _Trial, draw: Draw) -> Broken:
    """The memory holds the plan that was given in `plan_inputs`, and step and shift keep its size."""
    horizon = trial.linear
    layout, step = horizon.layout, horizon.step
    if "plan_inputs" not in layout or layout["plan_inputs"].size != _STAGES:
        yield f"memory() lays out {list(layout.names)}, expected 'plan_inputs' with {_STAGES} entries: inputs times stages"
    shapes, expected = [step.size_out(k) for k in range(step.n_out())], [(1, _STAGES), (5, 1), (layout.size, 1)]
    if shapes != expected:
        yield f"step gives {shapes}, expected {expected}: plan, diagnostics, memory"
    if (size := horizon.shifted(layout.start()).size) != layout.size:
        yield f"shifted() gives {size} entries, the memory has {layout.size}"
    plan = horizon.called(draw.normal(size=2))
    kept = float(np.abs(plan.memory[layout.slice("plan_inputs")] - plan.inputs[0]).max())
    if not within(kept, 1e-9 * (1 + np.abs(plan.inputs).max())):
        words = f"'plan_inputs' in its memory differs from the plan that it gave by {kept:.3g}"
        yield f"{words}: the next call would not begin with it"


def work_is_bounded_as_told(trial: _Trial, draw: Draw) -> Broken:
    """Where `unbounded` names a reason a solver is called; arithmetic of a fixed length takes no longer than it takes."""
    told, step = trial.optimiser.unbounded, trial.linear.step
    if told and not any(f.is_a(kind, True) for f in (step, *step.find_functions()) for kind in _SOLVERS):
        yield f"`unbounded` says '{told}', but its step calls no solver and always does the same work: a real loop would refuse it"


def numbers_are_true(trial: _Trial, draw: Draw) -> Broken:
    """Cost and stationarity are those of a simulation, and OK only where it is stationary: far away, nonlinear, at bounds."""
    nonlinear = _Horizon.of(trial.optimiser, 1.0, Limits())
    yield from _judged(trial, trial.linear, trial.linear.called(_FAR * draw.normal(size=2)))
    for horizon, sizes in ((trial.linear, (1.0,)), (nonlinear, (1.0, 1.0, 1.0)), (trial.bounded, (1.0, 3.0, 10.0))):
        for size in sizes if horizon.served else ():
            plan = horizon.solved(size * draw.normal(size=2))
            yield from _judged(trial, horizon, plan)
            if plan.status != Status.OK:
                yield f"after {_CALLS} calls its status is {plan.status.name}, its stationarity {plan.diagnostics[1]:.3g}"
            start = horizon.begun(3 * draw.normal(size=_STAGES))
            yield from _judged(trial, horizon, horizon.called(3 * draw.normal(size=2), start))


def _judged(trial: _Trial, horizon: _Horizon, plan: _Plan) -> Iterator[str]:
    """Compare the reported numbers of a plan with its true ones."""
    if plan.status not in (Status.OK, Status.NOT_CONVERGED):
        return
    told, stationarity, *_ = plan.diagnostics
    cost, residual = horizon.cost(plan.state, plan.inputs), horizon.residual(plan.state, plan.inputs)
    outside = float(np.abs(np.clip(plan.inputs, horizon.ocp.input_lower, horizon.ocp.input_upper) - plan.inputs).max())
    if not within(outside, 1e-9):
        yield f"an input of its plan is {outside:.3g} outside its bounds"
    if not within(told - cost, 1e-9 * (1 + abs(cost))):
        yield f"it reports the cost {told:.9g} of the plan, simulation gives {cost:.9g}"
    size = max(1.0, float(np.abs(plan.state).max()))
    allowed = _SLACK * trial.tolerance + _DIFFERENCE * size**0.5
    if plan.status == Status.OK and not residual <= allowed:
        yield f"it calls a plan OK whose stationarity by central differences is {residual:.3g}, above {trial.tolerance:g}"
    if not within(stationarity - residual, allowed + 0.01 * residual):
        yield f"it reports the stationarity {stationarity:.4g}, central differences give {residual:.4g}"
    if plan.status == Status.NOT_CONVERGED and stationarity <= trial.tolerance * (1 - 1e-9):
        yield f"it reports NOT_CONVERGED at the stationarity {stationarity:.3g}, which is within {trial.tolerance:g}"


def iterations_are_counted(trial: _Trial, draw: Draw) -> Broken:
    """The number of iterations that it reports is what the plan took: allowed that many, it finds the same plan."""
    most, horizon, state = getattr(trial.optimiser, "iterations", None), trial.linear, draw.normal(size=2)
    if not isinstance(most, int):
        return
    plan = horizon.called(state)
    count = float(plan.diagnostics[3])
    if not 0 <= count < most and count not in (most, UNKNOWN_ITERATIONS):
        yield f"it reports {count:g} iterations, of at most {most}"
    fewer = replaced(trial.optimiser, "iterations", max(1, round(count)))
    if fewer is None or not 0 <= count < most:
        return
    missed = float(np.abs(replace(horizon, optimiser=fewer).called(state).inputs - plan.inputs).max())
    if not within(missed, 2 * _SLACK * _REACH * trial.tolerance + 1e-9):
        words = f"it reports {count:g} iterations, but with iterations={max(1, round(count))}"
        yield f"{words} an input of its plan is off by {missed:.3g}"


def bounds_of_a_call_count(trial: _Trial, draw: Draw) -> Broken:
    """The bounds of a call hold from the first call on, and not those of the problem."""
    horizon, lower, upper = trial.bounded, -0.5 * _BOUND, 0.1 * _BOUND
    if horizon.served:
        memory = horizon.begun(draw.normal(size=_STAGES))
        inputs = horizon.called(3 * draw.normal(size=2), memory, lower=lower, upper=upper).inputs
        worst = float(np.maximum(lower - inputs, inputs - upper).max())
        if not worst <= 1e-9:
            yield f"given bounds ({lower:g}, {upper:g}), it plans an input {worst:.3g} outside of them"


def infeasible_is_told(trial: _Trial, draw: Draw) -> Broken:
    """A limit of a state that cannot be kept is never called OK; or limits of states are refused."""
    limits = Limits(inputs={"u": (-_BOUND, _BOUND)}, states={"y": (-_CORRIDOR, _CORRIDOR)})
    horizon = _Horizon.of(trial.optimiser, 0.0, limits)
    if not horizon.served:
        return
    plan = horizon.solved(np.array([2.0, float(draw.uniform(1.0, 2.0))]), most=_FEW)
    worst = max(float(np.abs(s[0])) for s in horizon.states(plan.state, plan.inputs)[1:]) - _CORRIDOR
    if plan.status == Status.OK:
        yield f"it calls a plan OK that violates a limit of a state by {worst:.3g}"
    if plan.status != Status.NON_FINITE and not within(plan.diagnostics[2] - worst, FEASIBLE):
        yield f"it reports a limit violated by {plan.diagnostics[2]:.3g}, simulation gives {worst:.3g}"


def nan_is_told(trial: _Trial, draw: Draw) -> Broken:
    """A state or data that are no numbers give NON_FINITE and a finite plan; no memory, NaN itself included, stays not finite."""
    horizon, state = trial.linear, draw.normal(size=2)
    memory, spoilt = horizon.begun(horizon.solved(state).inputs[0]), horizon.data.copy()
    spoilt[horizon.ocp.data.slice("reference"), _STAGES // 2] = np.nan
    given = {
        "a state of NaN": (np.array([np.nan, 0.0]), horizon.data),
        "an infinite state": (np.array([0.0, np.inf]), horizon.data),
        "a reference of NaN": (state, spoilt),
    }
    after = {"a memory of NaN": np.full(horizon.layout.size, np.nan)}
    for what, (first, data) in given.items():
        plan = horizon.called(first, memory, data=data)
        if plan.status != Status.NON_FINITE or not np.isfinite([*plan.inputs[0], *plan.memory]).all():
            yield f"given {what}, its status is {plan.status.name}, its plan {plan.inputs[0]}, its memory {plan.memory}"
        after[what] = plan.memory
    for what, before in after.items():
        plan = horizon.solved(state, before)
        if plan.status != Status.OK or not np.isfinite(plan.memory).all():
            yield f"after {what} it does not recover: its status is {plan.status.name}, its memory {plan.memory}"


def solution_stays(trial: _Trial, draw: Draw) -> Broken:
    """A call at a solution stays there with the status OK, and one stage later the shifted plan serves as well."""
    horizon, state, allowed = trial.linear, draw.normal(size=2), 2 * _SLACK * _REACH * trial.tolerance + 1e-9
    solved = horizon.solved(state)
    again = horizon.called(state, solved.memory)
    change = float(np.abs(again.inputs - solved.inputs).max())
    if not within(change, allowed) or again.status != Status.OK:
        yield f"called again at a solution it moves the plan by {change:.3g}, and its status is {again.status.name}"
    shifted = horizon.shifted(again.memory)
    missed = float(np.abs(shifted[horizon.layout.slice("plan_inputs")][:-1] - again.inputs[0, 1:]).max())
    if not within(missed, allowed):
        yield f"shifted() changes inputs of the plan by {missed:.3g} besides dropping the first stage"
    later = horizon.solved(horizon.states(state, again.inputs)[1], shifted)
    if later.status != Status.OK:
        yield f"from the shifted plan of the stage before its status is {later.status.name}"
