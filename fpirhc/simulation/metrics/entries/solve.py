"""Cycles of the whole run by status, and iterations, residuals and plans of the optimiser; none where the controller has none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fpirhc.simulation.metrics.base import Function, Metric
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.summary import written_out
from fpirhc.task.problem import Problem

# A run of a simulated plant counts these even where they never occurred; the others are statuses of a machine.
_ALWAYS = (Status.OK, Status.NOT_CONVERGED, Status.INFEASIBLE, Status.HELD, Status.NON_FINITE)


def cycles(problem: Problem, run: Run) -> int:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of cycles."""
    return run.cycles


def status(problem: Problem, run: Run) -> dict[str, int]:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of cycles of the whole run by status; that in which a run ended early counts as NON_FINITE."""
    counts = {s: int((run["status"] == s).sum()) for s in Status}
    counts[Status.NON_FINITE] += run.stop is not None
    return {s.name: count for s, count in counts.items() if count or s in _ALWAYS}


_CYCLES = (
    Metric("cycles", cycles, better="neither", report=False, compared="exact", finite=True, order=5),
    Metric("status", status, by="status", better="neither", report=False, compared="exact", finite=True, order=80),
)


def iterations(value: float) -> str:
    """Return a number of iterations as text; an optimiser that does not report the number logs -1."""
    return f"{value:.0f}" if value >= 0 else "-"


def _over(column: str, summary: Callable[[np.ndarray], np.floating]) -> Function:
    """Function of a metric that sums up one column of 'solve'; a plan that is not finite has an entry there, but no such number."""

    def function(problem: Problem, run: Run) -> float | None:  # noqa: ARG001 -- every metric is given the problem
        if "solve" not in run.layout:
            return None
        counts = column == "iterations" or run["solve.status"] < Status.NON_FINITE
        values = run[f"solve.{column}"][np.broadcast_to(counts, run.cycles)]
        return float(summary(values)) if values.size else None

    return function


def plans(problem: Problem, run: Run) -> int | None:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of different plans."""
    if "solve" not in run.layout or not run.cycles:
        return None
    return len(np.unique(run["solve"], axis=0))  # a plan that is held for several cycles counts once


def residual(value: float) -> str:
    """Return a residual in one digit."""
    return written_out(value, 1)


METRICS = (
    *_CYCLES,
    Metric(
        "solve.median_iterations",
        _over("iterations", np.median),
        title="iterations",
        short="iter",
        text=iterations,
        finite=True,
        order=90,
    ),
    Metric("solve.worst_iterations", _over("iterations", np.max), text=iterations, report=False, finite=True, order=90),
    Metric(
        "solve.median_stationarity",
        _over("stationarity", np.median),
        text=residual,
        title="residual",
        short="residual",
        report=False,
        compared="not",
        order=90,
    ),
    Metric("solve.worst_stationarity", _over("stationarity", np.max), title="worst residual", compared="not", order=90),
    Metric("solve.worst_feasibility", _over("feasibility", np.max), report=False, compared="not", order=90),
    Metric("plans", plans, better="neither", report=False, compared="exact", finite=True, order=90),
)
