"""The time of one control cycle: the controller alone, from measurement to command."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.simulation.run import Run
from fpirhc.simulation.stepper import Stepper
from fpirhc.task.problem import Problem, cycles_per_stage

REPLAYED = 2000  # cycles of the run that are stepped again, one by one


@dataclass(frozen=True)
class CycleTime:
    """Wall time of one call of `Stepper.step`, microseconds; only `first` includes the first call.

    Args:
        median: median of the mean over the cycles from one plan to the next, so that it includes its share of planning.
        p99: 99th percentile.
        maximum: largest time.
        first: time of the first call.
        planning: median of the cycles in which a new plan is made; of all cycles where no plan is made.
    """

    median: float
    p99: float
    maximum: float
    first: float
    planning: float


def measure_cycle(problem: Problem, controller: Controller, run: Run, *, compiled: bool = True) -> CycleTime | None:
    """Replay the run's measurements through the controller, one call per cycle, and return the times.

    The replay repeats the computations of the run: the controller starts afresh and has the same measurements.
    The result is None for a run of fewer than two cycles.
    """
    cycles = min(run.cycles, REPLAYED)
    if cycles < 2:
        return None
    stepper = Stepper(problem, controller, compiled=compiled, bounded=False)
    memory = stepper.start()
    taken = np.empty(cycles)
    times, states, realised = run.time[:cycles], run["state"][:cycles], run["realised"][:cycles]
    for k in range(cycles):
        begin = time.perf_counter_ns()
        _, memory = stepper.step(times[k], states[k], realised[k], memory)
        taken[k] = time.perf_counter_ns() - begin
    micro = taken / 1e3
    later = micro[1:]
    stride = cycles_per_stage(problem.horizon, problem.period) if problem.horizon and "solve" in run.layout else 1
    plans = micro[stride::stride] if cycles > stride else micro
    # Whole plan periods: where every other cycle plans, the median of single cycles would be the one or the other by chance.
    whole = later[: later.size - later.size % stride] if later.size >= stride else later
    periods = whole.reshape(-1, stride) if later.size >= stride else whole[:, None]
    return CycleTime(
        median=float(np.median(periods.mean(axis=1))),
        p99=float(np.quantile(later, 0.99)),
        maximum=float(later.max()),
        first=float(micro[0]),
        planning=float(np.median(plans)),
    )
