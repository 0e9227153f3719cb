"""Fresh results: one controller under one variant, as numbers by metric; many of them in any number of processes."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from fpirhc.baselines.catalogue import NOT_COMPARED, family_of
from fpirhc.baselines.variants import Variant
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved
from fpirhc.errors import FpirhcError
from fpirhc.problem_files.problem_file import Task, load_problem
from fpirhc.simulation.metrics import measure
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.studies.open_loop import solve_first
from fpirhc.task.problem import Problem

FINISHED, DIVERGED, REFUSED = "finished", "diverged", "refused"
Number = float | str
Progress = Callable[[str, int, int], None]

_CONVERGED = 1e-8  # of the input's range: tolerance of open-loop plans


@dataclass(frozen=True)
class Measurement:
    """The result of one run.

    Args:
        outcome: class of its outcome.
        why: reason for an outcome other than `FINISHED`.
        numbers: its numbers by metric; NaN where there is none.
    """

    outcome: str
    why: str
    numbers: Mapping[str, Number]


@dataclass(frozen=True)
class Job:
    """One controller under one variant.

    Args:
        controller: name of the controller.
        variant: the variant.
    """

    controller: str
    variant: Variant


def measure_all(
    task: Task, jobs: Sequence[Job], *, processes: int = 1, progress: Progress | None = None
) -> list[Measurement]:
    """Return the results of all jobs in their order, which does not depend on the number of processes."""
    if processes <= 1 or len(jobs) < 2:
        return _collected(task.name, (measure_job(task, job) for job in jobs), len(jobs), progress)
    # Spawned, because a forked process shares CasADi's state with its parent.
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(jobs)), mp_context=fresh) as pool:
        results = pool.map(_measure_by_path, [(str(task.path.resolve()), job) for job in jobs])
        try:
            return _collected(task.name, results, len(jobs), progress)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _collected(name: str, results: Iterable[Measurement], total: int, progress: Progress | None) -> list[Measurement]:
    measurements: list[Measurement] = []
    if progress:
        progress(name, 0, total)  # the first run may take long
    for one in results:
        measurements.append(one)
        if progress:
            progress(name, len(measurements), total)
    return measurements


def _measure_by_path(path_and_job: tuple[str, Job]) -> Measurement:
    path, job = path_and_job
    return measure_job(_loaded(path), job)


@cache
def _loaded(path: str) -> Task:
    return load_problem(path)


def measure_job(task: Task, job: Job) -> Measurement:
    """Run one controller under one variant; a refusal by fpirhc is an outcome too."""
    variant, controller = job.variant, task.controllers[job.controller]
    problem = variant.applied(task.problem)
    try:
        ready = resolved(problem, controller)
        run = simulate(problem, ready, seed=variant.seed, compiled=variant.compiled, flags=variant.flags)
        if run.stop is not None:
            return Measurement(DIVERGED, run.stop, {})
        numbers = _numbers(task, problem, run)
        for metric, value in numbers.items():
            if family_of(metric, task.metrics).finite and isinstance(value, float) and not math.isfinite(value):
                return Measurement(DIVERGED, f"{metric} is not finite", {})
        plan = first_plan(task, problem, ready) if variant.plans else {}
    except FpirhcError as error:
        return Measurement(f"{REFUSED} ({type(error).__name__})", str(error), {})
    return Measurement(FINISHED, "", {**numbers, **plan})


def _numbers(task: Task, problem: Problem, run: Run) -> dict[str, Number]:
    measured = measure(problem, run, task.metrics)
    return {m.key(element): value for m, element, value in measured if m.compared != NOT_COMPARED}


def first_plan(task: Task, problem: Problem, controller: Controller) -> dict[str, Number]:
    """Solve the first horizon with the controller's cost to convergence; empty for a controller that does not plan."""
    planning = controller.planner
    cost = (planning.cost or problem.cost) if planning else None
    if cost is None or problem.horizon is None:
        return {}
    lower, upper = problem.limits.input_bounds(problem.plant)
    reach = np.append((upper - lower)[np.isfinite(upper - lower)], 0.0).max() or 1.0
    with_cost = replace(task, problem=replace(problem, cost=cost))
    try:
        solved = solve_first(with_cost, ["fixed-point"], _CONVERGED * float(reach))[0]
    except FpirhcError as error:
        return {"plan.status": f"{REFUSED} ({type(error).__name__})"}
    return {
        "plan.cost": math.nan if solved.plan.cost is None else solved.plan.cost,
        "plan.stages": solved.plan.inputs.shape[1],
        "plan.iterations": int(solved.plan.iterations),
        "plan.status": solved.plan.status.name,
        "plan.factor": solved.certificate.factor if solved.certificate else math.nan,
    }
