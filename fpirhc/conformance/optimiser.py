"""Laws that every optimiser keeps, tried on small horizons whose solutions are known by other means."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from scipy.optimize import lsq_linear

from fpirhc.conformance.horizons import BOUND, CORRIDOR, STAGES, STEP, Trial, TrialHorizon, TrialPlan
from fpirhc.conformance.laws import frozen_value, hold, keep, within
from fpirhc.fields.checked import checked_call, replaced
from fpirhc.fields.kinds import Count, Range, Seed
from fpirhc.optimisers.base import FEASIBLE, UNKNOWN_ITERATIONS, Optimiser
from fpirhc.status import Status

_SLACK = 2.0  # allowed error of a stationarity, in tolerances
_DIFFERENCE = 1e-6  # relative error of central differences of a cost
_TRIALS = 3
_FAR = 1e6  # size of a state from which no plan is converged after a few iterations
_ROUNDING = 1e-8  # of the numbers of such a plan, relative
_SOLVERS = ("Nlpsol", "Conic", "Rootfinder", "Integrator", "External", "CallbackInternal")
_FEW = 5  # calls on a problem without solution


@checked_call
def check_optimiser(
    optimiser: Optimiser,
    *,
    tolerance: Annotated[float, Range("a number above 0 and up to 1e-3", 0.0, 1e-3, open_low=True)],
    seed: Seed,
    calls: Count = 50,
) -> None:
    """Check every law on an optimiser.

    Args:
        optimiser: the optimiser.
        tolerance: stationarity, in the unit of the inputs, below which it calls a plan OK.
        seed: of first states and plans.
        calls: calls of its step within which it must solve a small convex problem.

    Raises:
        AssertionError: the first law that does not hold, in one sentence.
        InvalidValue: a tolerance that is not positive, or above 1e-3, which is too coarse to recognise a solution.
    """
    keep(optimiser, Trial(optimiser, tolerance, calls), LAWS, seed)


def remembers_a_plan(trial: Trial, generator: np.random.Generator) -> None:
    """The memory holds the plan that was given in `plan_inputs`, and step and shift keep its size."""
    task = trial.linear
    layout = task.layout
    hold("plan_inputs" in layout, f"memory() lays out {list(layout.names)}, but not 'plan_inputs'")
    size = layout["plan_inputs"].size
    hold(size == STAGES, f"'plan_inputs' has {size} entries, expected {STAGES}: inputs times stages")
    shapes = [task.step.size_out(k) for k in range(task.step.n_out())]
    expected = [(1, STAGES), (5, 1), (layout.size, 1)]
    hold(shapes == expected, f"step gives {shapes}, expected {expected}: plan, diagnostics, memory")
    size = task.shifted.numel_out(0)
    hold(size == layout.size, f"shifted() gives {size} entries, the memory has {layout.size}")
    plan = task.called(generator.normal(size=2), layout.start())
    kept = float(np.abs(plan.memory[layout.slice("plan_inputs")] - plan.inputs[0]).max())
    hold(
        within(kept, 1e-9 * (1 + np.abs(plan.inputs).max())),
        f"'plan_inputs' in its memory differs from the plan that it gave by {kept:.3g}: the next call would not begin with it",
    )


def work_is_bounded_as_told(trial: Trial, generator: np.random.Generator) -> None:  # noqa: ARG001
    """Where `unbounded` names a reason a solver is called; arithmetic of a fixed length takes no longer than it takes."""
    told, task = trial.optimiser.unbounded, trial.linear
    functions = (task.step, *task.step.find_functions())
    solvers = [f.name() for f in functions if any(f.is_a(kind, True) for kind in _SOLVERS)]
    hold(
        not told or bool(solvers),
        f"`unbounded` says '{told}', but its step calls no solver and always does the same work: a real loop would refuse it",
    )


def numbers_are_true_far_away(trial: Trial, generator: np.random.Generator) -> None:
    """From a state as large as 1e6 one call reports the stationarity that the plan has, and OK only where it is converged."""
    task = trial.linear
    state, (by_u, by_s) = _FAR * generator.normal(size=2), task.squares
    plan = task.called(state, task.layout.start())
    if plan.status not in (Status.OK, Status.NOT_CONVERGED):
        return
    slope = 2 * by_u.T @ (by_u @ plan.inputs[0] + by_s @ state)
    residual = float(np.abs(slope).max() / (STEP * task.ocp.curvature[0]))
    floor = _ROUNDING * _FAR
    hold(
        within(plan.stationarity - residual, 0.01 * residual + floor),
        f"far from a solution it reports the stationarity {plan.stationarity:.4g} of a plan that has {residual:.4g}",
    )
    hold(
        plan.status != Status.OK or residual <= _SLACK * trial.tolerance + floor,
        f"it calls a plan OK whose stationarity is {residual:.4g}, above {trial.tolerance:g}",
    )


def iterations_are_counted(trial: Trial, generator: np.random.Generator) -> None:
    """The number of iterations that it reports is what the plan took: allowed that many, it finds the same plan."""
    most = getattr(trial.optimiser, "iterations", None)
    if not isinstance(most, int):
        return
    task, state = trial.linear, generator.normal(size=2)
    plan = task.called(state, task.layout.start())
    count = float(plan.diagnostics[3])
    if not 0 <= count < most:
        hold(count <= most or count == UNKNOWN_ITERATIONS, f"it reports {count:g} iterations, of at most {most}")
        return
    allowed_as_many = replaced(trial.optimiser, "iterations", max(1, round(count)))
    if allowed_as_many is None:
        return
    fewer = replace(task, optimiser=allowed_as_many)
    again = fewer.called(state, fewer.layout.start())
    missed = float(np.abs(again.inputs - plan.inputs).max())
    allowed = 2 * _SLACK * task.reach * trial.tolerance + 1e-9
    hold(
        within(missed, allowed),
        f"it reports {count:g} iterations, but with iterations={max(1, round(count))} an input of its plan is off by {missed:.3g}",
    )


def plan_is_least_squares(trial: Trial, generator: np.random.Generator) -> None:
    """On a linear model the plan is scipy's least-squares solution, without bounds and within those of inputs; or they are refused.

    The sum of squares ends with the weight of scipy's Riccati equation, so that without bounds the plan is u_i = -K s_i.
    """
    far = (1.0, 3.0, 10.0)
    for task, bound, sizes, ease in ((trial.linear, np.inf, far[:1], 1.0), (trial.bounded, BOUND, far, 10.0)):
        by_u, by_s = task.squares
        # Inputs at a bound leave fewer free ones, whose Hessian may be worse than the whole.
        allowed = ease * (_SLACK * task.reach * trial.tolerance + 1e-9)
        for size in sizes if task.served else ():
            plan = task.solved(size * generator.normal(size=2))
            outside = float(np.abs(plan.inputs).max()) - bound
            hold(outside <= 1e-9, f"an input is {outside:.3g} outside its bounds of {bound:g}")
            words = f"{plan.status.name} after {plan.calls} calls, its stationarity {plan.stationarity:.3g}"
            hold(plan.status == Status.OK, f"on a linear model with inputs up to {bound:g} its status is {words}")
            best = lsq_linear(by_u, -by_s @ plan.state, (-bound, bound), tol=1e-14, method="bvls").x
            missed = float(np.abs(plan.inputs[0] - best).max())
            hold(within(missed, allowed), f"an input of its plan is off by {missed:.3g}, allowed is {allowed:.3g}")


def plan_is_stationary(trial: Trial, generator: np.random.Generator) -> None:
    """A plan called OK is stationary by central differences, and its numbers are true, from a bad first plan too."""
    task = trial.nonlinear
    for _ in range(_TRIALS):
        plan = task.solved(generator.normal(size=2))
        _judged(trial, task, plan)
        hold(plan.status == Status.OK, f"after {plan.calls} calls its status is {plan.status.name}")
        plan = task.called(3 * generator.normal(size=2), task.begun(3 * generator.normal(size=STAGES)))
        if plan.status in (Status.OK, Status.NOT_CONVERGED):
            _judged(trial, task, plan)
        hold(
            plan.status != Status.NOT_CONVERGED or plan.stationarity > trial.tolerance * (1 - 1e-9),
            f"it reports NOT_CONVERGED at the stationarity {plan.stationarity:.3g}, which is within {trial.tolerance:g}",
        )


def _judged(trial: Trial, task: TrialHorizon, plan: TrialPlan) -> None:
    """Compare the reported numbers of a plan with its true ones."""
    cost, residual = task.value(plan.state, plan.inputs), task.residual(plan.state, plan.inputs)
    hold(
        within(plan.cost - cost, 1e-9 * (1 + abs(cost))),
        f"it reports the cost {plan.cost:.9g} of the plan, simulation gives {cost:.9g}",
    )
    allowed = _SLACK * trial.tolerance + _DIFFERENCE * (1 + cost)
    hold(
        plan.status != Status.OK or residual <= allowed,
        f"it calls a plan OK whose stationarity by central differences is {residual:.3g}, above {trial.tolerance:g}",
    )
    hold(
        within(plan.stationarity - residual, allowed + 0.01 * residual),
        f"it reports the stationarity {plan.stationarity:.3g}, central differences give {residual:.3g}",
    )


def bounds_of_a_call_count(trial: Trial, generator: np.random.Generator) -> None:
    """The bounds of a call hold from the first call on, and not those of the problem."""
    task = trial.bounded
    if not task.served:
        return
    lower, upper = -0.5 * BOUND, 0.1 * BOUND
    memory = task.begun(generator.normal(size=STAGES))
    inputs = np.asarray(task.step(3 * generator.normal(size=2), task.data, lower, upper, memory)[0].full())
    worst = float(np.maximum(lower - inputs, inputs - upper).max())
    hold(worst <= 1e-9, f"given bounds ({lower:g}, {upper:g}), it plans an input {worst:.3g} outside of them")


def infeasible_is_told(trial: Trial, generator: np.random.Generator) -> None:
    """A limit of a state that cannot be kept is never called OK; or limits of states are refused."""
    task = trial.impossible
    if not task.served:
        return
    plan = task.solved(np.array([2.0, float(generator.uniform(1.0, 2.0))]), most=_FEW)
    worst = max(float(np.abs(s[0])) for s in task.states(plan.state, plan.inputs)[1:]) - CORRIDOR
    hold(plan.status != Status.OK, f"it calls a plan OK that violates a limit of a state by {worst:.3g}")
    reported = float(plan.diagnostics[2])
    hold(
        plan.status == Status.NON_FINITE or within(reported - worst, FEASIBLE),
        f"it reports a limit violated by {reported:.3g}, simulation gives {worst:.3g}",
    )


def nan_is_told(trial: Trial, generator: np.random.Generator) -> None:
    """A state or data that are no numbers give NON_FINITE and a finite plan; no memory, NaN itself included, stays not finite."""
    task, state = trial.linear, generator.normal(size=2)
    memory, spoilt = task.begun(task.solved(state).inputs[0]), task.data.copy()
    spoilt[task.ocp.data.slice("reference"), STAGES // 2] = np.nan
    poisoned = np.full(task.layout.size, np.nan)
    for what, first, before, data in (
        ("a state of NaN", np.array([np.nan, 0.0]), memory, task.data),
        ("an infinite state", np.array([0.0, np.inf]), memory, task.data),
        ("a reference of NaN", state, memory, spoilt),
        ("a memory of NaN", None, poisoned, task.data),
    ):
        if first is not None:
            plan = task.called(first, before, data)
            hold(
                plan.status == Status.NON_FINITE, f"given {what}, its status is {plan.status.name}, expected NON_FINITE"
            )
            hold(bool(np.isfinite(plan.inputs).all()), f"given {what}, it plans {plan.inputs[0]}")
            hold(bool(np.isfinite(plan.memory).all()), f"given {what}, it remembers values that are not finite")
            before = plan.memory
        after = task.solved(state, before)
        hold(after.status == Status.OK, f"after {what} it does not recover: its status is {after.status.name}")
        hold(bool(np.isfinite(after.memory).all()), f"after {what} its memory still has NaN")


def solution_stays(trial: Trial, generator: np.random.Generator) -> None:
    """A call at a solution stays there with the status OK, and one stage later the shifted plan serves as well."""
    task = trial.linear
    (a, b), state = task.model, generator.normal(size=2)
    again = task.called(state, (solved := task.solved(state)).memory)
    change, allowed = (
        float(np.abs(again.inputs - solved.inputs).max()),
        2 * _SLACK * task.reach * trial.tolerance + 1e-9,
    )
    hold(
        within(change, allowed),
        f"called again at a solution it moves the plan by {change:.3g}, allowed is {allowed:.3g}",
    )
    hold(again.status == Status.OK, f"called again at a solution its status is {again.status.name}")
    shifted = np.asarray(task.shifted(again.memory).full())[:, 0]
    missed = float(np.abs(shifted[task.layout.slice("plan_inputs")][:-1] - again.inputs[0, 1:]).max())
    what = f"shifted() changes inputs of the plan by {missed:.3g} besides dropping the first stage"
    hold(within(missed, allowed), what)
    later = task.solved(a @ state + b[:, 0] * again.inputs[0, 0], shifted)
    hold(later.status == Status.OK, f"from the shifted plan of the stage before its status is {later.status.name}")


LAWS = (
    frozen_value,
    remembers_a_plan,
    work_is_bounded_as_told,
    numbers_are_true_far_away,
    plan_is_least_squares,
    plan_is_stationary,
    iterations_are_counted,
    bounds_of_a_call_count,
    infeasible_is_told,
    nan_is_told,
    solution_stays,
)
