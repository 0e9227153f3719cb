"""Fresh results: one controller under one variant, as numbers by metric; many of them in any number of processes."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved
from fpirhc.errors import FpirhcError, InvalidName, nearest
from fpirhc.problem_files.problem_file import Task, load_problem
from fpirhc.simulation import metrics as run_metrics
from fpirhc.simulation.metrics import known_metrics, measure
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.simulation.tables import run_tables
from fpirhc.studies.open_loop import solve_first
from fpirhc.studies.view import Progress
from fpirhc.symbolic.native import find_compiler
from fpirhc.task.problem import Problem

FINISHED, DIVERGED, REFUSED = "finished", "diverged", "refused"
Number = float | str

_CONVERGED = 1e-8  # of the input's range: tolerance of open-loop plans


@dataclass(frozen=True)
class Measurement:
    """The result of one run."""

    outcome: str  # class of its outcome
    why: str  # reason for an outcome other than `FINISHED`
    numbers: Mapping[str, Number]  # its numbers by metric; NaN where there is none
    broken: Mapping[str, str] = field(
        default_factory=dict
    )  # why metrics have no number, by name: their functions raised


@dataclass(frozen=True)
class Job:
    """One controller under one variant."""

    controller: str  # name of the controller
    variant: Variant


def _no_run_has_it(problem: Problem, run: Run) -> None:
    """The first horizon's open-loop plan has these numbers, see `measuring.first_plan`."""


PLANS = {
    metric.name: metric
    for metric in (
        run_metrics.Metric("plan.cost", _no_run_has_it, better="neither", compared="tight", finite=True),
        run_metrics.Metric("plan.stages", _no_run_has_it, better="neither", compared="exact", finite=True),
        run_metrics.Metric("plan.iterations", _no_run_has_it, better="neither", compared="exact"),
        run_metrics.Metric("plan.status", _no_run_has_it, better="neither", compared="exact", finite=True),
        # A difference of eigenvalues from one.
        run_metrics.Metric("plan.factor", _no_run_has_it, floor=1e-4),
    )
}


def metric_of(key: str, metrics: Sequence[run_metrics.Metric] | None = None) -> run_metrics.Metric:
    """Return the metric of a number, which says how it is compared. `key`: name of the number, 'metric.element'."""
    entries = {**PLANS, **{m.name: m for m in (known_metrics() if metrics is None else metrics)}}
    name = key
    while name not in entries and "." in name:  # an element may have dots of its own
        name = name.rpartition(".")[0]
    if name not in entries:
        raise InvalidName(f"metric '{key}' is unknown.{nearest(name, entries)}")
    return entries[name]


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
        measured = measure(problem, run, task.metrics)
        numbers = _numbers(measured)
        for metric, value in numbers.items():
            if metric_of(metric, task.metrics).finite and isinstance(value, float) and not math.isfinite(value):
                return Measurement(DIVERGED, f"{metric} is not finite", {})
        plan = first_plan(task, problem, ready) if variant.plans else {}
    except FpirhcError as error:
        return Measurement(f"{REFUSED} ({type(error).__name__})", str(error), {})
    return Measurement(FINISHED, "", {**numbers, **plan}, measured.broken)


def _numbers(measured: run_metrics.Metrics) -> dict[str, Number]:
    return {m.key(element): value for m, element, value in measured if m.compared != "not"}


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


NOMINAL, SEEDS, ROUNDING, INTEGRATOR = "nominal", "seeds", "rounding", "integrator"
SOURCES = (SEEDS, ROUNDING, INTEGRATOR)
_NUDGE = 1e-14  # some tens of rounding errors


@dataclass(frozen=True)
class Variant:
    """One way to run a problem that leaves its settings alone."""

    source: str  # source of spread to which it belongs
    name: str  # its name in words
    seed: int  # seed of the run
    compiled: bool  # whether the run uses compiled C
    flags: tuple[str, ...] = ()  # flags of the compiler
    nudge: float = 0.0  # relative change of the first state and the exact parameters
    finer: int = 1  # factor of the number of integrator steps

    @property
    def plans(self) -> bool:
        """Whether open-loop plans can differ in this variant: they are solved in the virtual machine, without noise."""
        return self.source == NOMINAL or self.nudge > 0

    def applied(self, problem: Problem) -> Problem:
        """Return the problem as it runs in this variant."""
        if self.nudge:
            start = {name: value * (1 + self.nudge) for name, value in problem.start.items()}
            elsewhere = replace(problem, start=start)
            exact = np.array([one.exact for one in problem.moved.parameters.values()])
            return elsewhere.with_exact(exact * (1 + self.nudge)) if exact.size else elsewhere
        if self.finer > 1:
            return problem.finer(self.finer) or problem
        return problem


def nominal(seed: int, compiled: bool) -> Variant:
    """Return the variant that `check` measures."""
    return Variant(NOMINAL, "nominal", seed, compiled)


def variants(problem: Problem, *, seed: int, seeds: int, compiled: bool) -> list[Variant]:
    """Return the nominal variant and all others that can differ from it; without noise there is one seed only."""
    all_variants = [nominal(seed, compiled)]
    if _is_random(problem):
        all_variants += [Variant(SEEDS, f"seed {seed + k}", seed + k, compiled) for k in range(1, seeds)]
    if compiled and find_compiler():
        all_variants.append(Variant(ROUNDING, "virtual machine", seed, False))
        all_variants.append(Variant(ROUNDING, "compiled -O0", seed, True, flags=("-O0",)))
    all_variants.append(
        Variant(ROUNDING, f"start and exact parameters moved by {_NUDGE:g}", seed, compiled, nudge=_NUDGE)
    )
    if problem.finer(2):
        all_variants.append(Variant(INTEGRATOR, "twice the integrator steps", seed, compiled, finer=2))
    return all_variants


def names_by_source(all_variants: Sequence[Variant]) -> dict[str, list[str]]:
    """Return the names of the variants by their source."""
    return {source: [v.name for v in all_variants if v.source == source] for source in SOURCES}


def _is_random(problem: Problem) -> bool:
    tables = zip(*(run_tables(problem, seed, problem.cycles) for seed in (0, 1)), strict=True)
    return not all(np.array_equal(one, other) for one, other in tables)
