"""The stage cost along a run."""

from __future__ import annotations

from fpirhc.simulation.metrics.base import Metric, by_name, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem


def cost(problem: Problem, run: Run) -> dict[str, float]:
    """Return the sum of the problem's stage cost by term, and 'total', from `measure_from` on; empty for a run that ended early."""
    if "cost" not in run.layout or run.stop is not None:
        return {}
    terms = by_name(run.layout["cost"].elements, run["cost"][measured_cycles(problem, run)].sum(axis=0))
    return {**terms, "total": sum(terms.values())}


METRICS = (Metric("cost", cost, by="term", shown=("total",), finite=True, order=70),)
