"""The number of cycles of a run, and their status."""

from __future__ import annotations

import numpy as np

from fpirhc.simulation.metrics.base import Metric
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.task.problem import Problem

# A run of a simulated plant counts these even where they never occurred; the others are statuses of a machine.
_ALWAYS = (Status.OK, Status.NOT_CONVERGED, Status.INFEASIBLE, Status.HELD, Status.NON_FINITE)


def status(problem: Problem, run: Run) -> dict[str, float]:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of cycles of the whole run by status; the cycle in which a run ended early counts as NON_FINITE."""
    values, counts = np.unique(run["status"].astype(int), return_counts=True)
    cycles = dict.fromkeys((s.name for s in _ALWAYS), 0)
    cycles |= {Status(int(v)).name: int(c) for v, c in zip(values, counts, strict=True)}
    if run.stop is not None:
        cycles[Status.NON_FINITE.name] += 1
    return {**cycles}


def cycles(problem: Problem, run: Run) -> int:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of cycles."""
    return run.cycles


METRICS = (
    Metric("cycles", cycles, better="neither", report=False, compared="exact", finite=True, order=5),
    Metric("status", status, by="status", better="neither", report=False, compared="exact", finite=True, order=80),
)
