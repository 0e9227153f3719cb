"""Errors of the judged coordinates, from `measure_from` on, the time at which a run settled, and its stage cost."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.controllers.reference_states import given_signals, own_signals
from fpirhc.simulation.metrics.base import Metric, by_name, coordinate_unit, measured_cycles, measured_errors
from fpirhc.simulation.metrics.streamed import Cycle, Measured, Streamed, summed
from fpirhc.simulation.run import Run
from fpirhc.symbolic.latest import Latest
from fpirhc.task.problem import Problem


def cost(problem: Problem, run: Run) -> dict[str, float]:
    """Return the sum of the problem's stage cost by term, and 'total', from `measure_from` on; empty for a run that ended early."""
    if "cost" not in run.layout or run.stop is not None:
        return {}
    terms = by_name(run.layout["cost"].elements, run["cost"][measured_cycles(problem, run)].sum(axis=0))
    return {**terms, "total": sum(terms.values())}


_COST = (Metric("cost", cost, by="term", shown=("total",), finite=True, order=70, reads=("cost", "time")),)


_SMALLEST = 1e-12  # range of a reference
_RANGES: Latest[np.ndarray] = Latest(4)
SETTLED = 0.02  # half width of the band, as a share of the reference's range or of the first error, whichever is larger


def settling(problem: Problem, run: Run) -> dict[str, float]:  # noqa: ARG001 -- every metric is given the problem
    """Return the time from which |error| stays within the band; 0 where it always is, NaN where the run ends outside it."""
    return {name: _settling(run, name) for name in run.layout["error"].elements}


def _settling(run: Run, coordinate: str) -> float:
    if run.stop is not None or not run.cycles:
        return float("nan")
    error, reference = np.abs(run[f"true_error.{coordinate}"]), run[f"reference.{coordinate}"]
    band = SETTLED * max(float(np.ptp(reference)), float(error[0]), _SMALLEST)
    outside = np.flatnonzero(error > band)
    if not outside.size:
        return 0.0
    last = int(outside[-1])
    return float(run.time[last + 1]) if last + 1 < run.cycles else float("nan")


def _unsettled(run: Measured) -> np.ndarray | None:
    """Ranges of the references, the first errors, and the last cycles outside the band (-1: none).

    A reference with signals of its own, or from outside, has no range before it was run.
    """
    problem, names = run.problem, run.layout["error"].elements
    if own_signals(problem) or given_signals(problem):
        return None
    function = problem.reference_function

    def ranges() -> np.ndarray:
        times = np.arange(run.cycles) * problem.period
        return np.ptp(np.asarray(function.map(run.cycles)(times[None, :])[0].full()), axis=1)

    rows = _RANGES.of((function,), (run.cycles, problem.period), ranges)
    own = [rows[problem.plant.output.elements.index(name)] for name in names]
    return np.concatenate([own, np.zeros(len(own)), np.full(len(own), -1.0)])


def _last_outside(memory: ca.SX, cycle: Cycle) -> ca.SX:
    ranges, first, last = ca.vertsplit(memory, memory.numel() // 3)
    error = ca.fabs(cycle["true_error"])
    first = ca.if_else(cycle.number == 0, error, first)
    outside = error > SETTLED * ca.fmax(ca.fmax(ranges, first), _SMALLEST)
    return ca.vertcat(ranges, first, ca.if_else(outside, cycle.number, last))


def _settled(memories: np.ndarray, run: Measured) -> dict[str, np.ndarray]:
    last = np.split(memories, 3, axis=1)[2] + 1
    times = np.where(last < run.cycles, last * run.problem.period, np.nan)
    return dict(zip(run.layout["error"].elements, times.T, strict=True))


_SETTLING = (
    Metric(
        "settling",
        settling,
        by="coordinate",
        unit=lambda problem, _: problem.time_unit,
        title="settled",
        step=lambda period, _: period,
        order=40,
        streamed=Streamed(_unsettled, _last_outside, _settled),
    ),
)


def rms_error(problem: Problem, run: Run) -> dict[str, float]:
    """Return the root mean square of the error over the cycles, by coordinate."""
    return by_name(run.layout["error"].elements, np.sqrt(np.mean(measured_errors(problem, run) ** 2, axis=0)))


def max_error(problem: Problem, run: Run) -> dict[str, float]:
    """Return the largest size of the error, by coordinate."""
    return by_name(run.layout["error"].elements, np.max(np.abs(measured_errors(problem, run)), axis=0))


def iae(problem: Problem, run: Run) -> dict[str, float]:
    """Return the integral of the error's size over time, the sum over the cycles times the period, by coordinate."""
    sums = np.sum(np.abs(measured_errors(problem, run)), axis=0)
    return by_name(run.layout["error"].elements, sums * problem.period)


METRICS = (
    *_SETTLING,
    *_COST,
    Metric(
        "rms_error",
        rms_error,
        by="coordinate",
        unit=coordinate_unit,
        short="rms",
        headline=True,
        finite=True,
        order=10,
        streamed=summed("true_error", "error", lambda e: e * e, lambda sums, run: np.sqrt(sums / run.count)),
    ),
    Metric(
        "max_error",
        max_error,
        by="coordinate",
        unit=coordinate_unit,
        finite=True,
        order=20,
        streamed=summed("true_error", "error", ca.fabs, lambda sizes, _: sizes, ca.fmax),
    ),
    Metric(
        "iae",
        iae,
        by="coordinate",
        unit=lambda problem, name: f"{coordinate_unit(problem, name)} {problem.time_unit}",
        report=False,
        finite=True,
        order=30,
        streamed=summed("true_error", "error", ca.fabs, lambda sums, run: sums * run.problem.period),
    ),
)
