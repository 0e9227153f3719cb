"""Errors of the judged coordinates, from `measure_from` on, the time at which a run settled, and its stage cost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fpirhc.simulation.metrics.base import Metric, by_name, coordinate_unit, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem


def cost(problem: Problem, run: Run) -> dict[str, float]:
    """Return the sum of the problem's stage cost by term, and 'total', from `measure_from` on; empty for a run that ended early."""
    if "cost" not in run.layout or run.stop is not None:
        return {}
    terms = by_name(run.layout["cost"].elements, run["cost"][measured_cycles(problem, run)].sum(axis=0))
    return {**terms, "total": sum(terms.values())}


_COST = (Metric("cost", cost, by="term", shown=("total",), finite=True, order=70, reads=("cost",)),)


_SMALLEST = 1e-12  # range of a reference
SETTLED = 0.02  # half width of the band, as a share of the reference's range or of the first error, whichever is larger


def settling(problem: Problem, run: Run) -> dict[str, float]:
    """Return the time from which |error| stays within the band; 0 where it always is, NaN where the run ends outside it."""
    names, errors = run.layout["error"].elements, np.abs(run["true_error"])
    if run.stop is not None:
        return dict.fromkeys(names, np.nan)
    ranges = np.array([np.ptp(run[f"reference.{name}"]) for name in names])
    outside = errors > SETTLED * np.fmax(np.fmax(ranges, errors[0]), _SMALLEST)
    after = (outside * np.arange(1, run.cycles + 1)[:, None]).max(axis=0)
    return by_name(names, np.where(after < run.cycles, after * problem.period, np.nan))


_SETTLING = (
    Metric(
        "settling",
        settling,
        by="coordinate",
        unit=lambda problem, _: problem.time_unit,
        title="settled",
        step=lambda period, _: period,
        order=40,
    ),
)


def _of_errors(number: Callable[[np.ndarray, float], np.ndarray]) -> Callable[[Problem, Run], dict[str, float]]:
    """Function of a metric of every judged coordinate's measured errors and the period; a run that ended early has NaN."""

    def function(problem: Problem, run: Run) -> dict[str, float]:
        names, measured = run.layout["error"].elements, measured_cycles(problem, run)
        if run.stop is not None or not measured.any():
            return dict.fromkeys(names, np.nan)
        return by_name(names, number(run["true_error"][measured], problem.period))

    return function


rms_error = _of_errors(lambda e, _: np.sqrt((e * e).sum(axis=0) / len(e)))
max_error = _of_errors(lambda e, _: np.abs(e).max(axis=0))
iae = _of_errors(lambda e, period: np.abs(e).sum(axis=0) * period)  # the integral of |error| over time


METRICS = (
    *_SETTLING,
    *_COST,
    Metric(
        "rms_error", rms_error, by="coordinate", unit=coordinate_unit, short="rms", headline=True, finite=True, order=10
    ),
    Metric("max_error", max_error, by="coordinate", unit=coordinate_unit, finite=True, order=20),
    Metric(
        "iae",
        iae,
        by="coordinate",
        unit=lambda problem, name: f"{coordinate_unit(problem, name)} {problem.time_unit}",
        report=False,
        finite=True,
        order=30,
    ),
)
