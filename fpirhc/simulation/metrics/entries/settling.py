"""The time at which a run settled."""

from __future__ import annotations

import numpy as np

from fpirhc.simulation.metrics.base import Metric
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem

SETTLED = 0.02  # half width of the band, as a share of the reference's range or of the first error, whichever is larger


def settling(problem: Problem, run: Run) -> dict[str, float]:  # noqa: ARG001 -- every metric is given the problem
    """Return the time from which |error| stays within the band; 0 where it always is, NaN where the run ends outside it."""
    return {name: _settling(run, name) for name in run.layout["error"].elements}


def _settling(run: Run, coordinate: str) -> float:
    if run.stop is not None or not run.cycles:
        return float("nan")
    error, reference = np.abs(run[f"true_error.{coordinate}"]), run[f"reference.{coordinate}"]
    band = SETTLED * max(float(np.ptp(reference)), float(error[0]), 1e-12)
    outside = np.flatnonzero(error > band)
    if not outside.size:
        return 0.0
    last = int(outside[-1])
    return float(run.time[last + 1]) if last + 1 < run.cycles else float("nan")


METRICS = (
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
