"""Errors of the judged coordinates, from `measure_from` on, the time at which a run settled, and its stage cost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fpirhc.controllers.reference_states import given_signals, own_signals
from fpirhc.simulation.metrics.base import Metric, by_name, coordinate_unit, measured_cycles
from fpirhc.simulation.metrics.summed import Cycle, Measured, Summed, Term, larger
from fpirhc.simulation.run import Run
from fpirhc.symbolic.evaluate import Latest
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


def _ranges(run: Measured) -> np.ndarray | None:
    """Ranges of the references; one with signals of its own, or from outside, has none before it was run."""
    problem, names = run.problem, run.layout["error"].elements
    if run.run is not None:
        return np.array([np.ptp(run.run[f"reference.{name}"]) if run.cycles else 0.0 for name in names])
    if own_signals(problem) or given_signals(problem):
        return None
    function = problem.reference_function

    def ranges() -> np.ndarray:
        times = np.arange(run.cycles) * problem.period
        return np.ptp(np.asarray(function.map(run.cycles)(times[None, :])[0].full()), axis=1)

    rows = _RANGES.of((function,), (run.cycles, problem.period), ranges)
    return np.array([rows[problem.plant.output.elements.index(name)] for name in names])


def _outside(cycle: Cycle) -> Term:
    """Number of the cycle after this one where the error is outside the band, else 0."""
    scale = larger(cycle.constants, abs(cycle.first["true_error"]))
    return (abs(cycle["true_error"]) > SETTLED * larger(scale, _SMALLEST)) * (cycle.number + 1)


# The time from which |error| stays within the band; 0 where it always is, NaN where the run ends outside it.
settling = Summed(
    ("true_error",),
    "error",
    _outside,
    lambda after, run: np.where(after < run.cycles, after * run.problem.period, np.nan),
    largest=True,
    all_cycles=True,
    of_whole_runs=True,
    first=("true_error",),
    constants=_ranges,
)
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


def _of_errors(
    term: Callable[[Term], Term], number: Callable[[np.ndarray, Measured], np.ndarray], *, largest: bool = False
) -> Summed:
    """The metric of a term of every judged coordinate's error; a run that ended early has NaN."""
    reads = ("true_error",)
    return Summed(reads, "error", lambda cycle: term(cycle["true_error"]), number, largest=largest, of_whole_runs=True)


rms_error = _of_errors(lambda e: e * e, lambda sums, run: np.sqrt(sums / run.count))
max_error = _of_errors(abs, lambda sizes, _: sizes, largest=True)
iae = _of_errors(abs, lambda sums, run: sums * run.problem.period)  # the integral of |error| over time


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
