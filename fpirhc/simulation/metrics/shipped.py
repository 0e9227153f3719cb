"""Shipped metrics: errors and settling of what is judged, the commands, cycles by status, and the plans of an optimiser."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fpirhc.plant.motion import derivative_unit
from fpirhc.simulation.metrics.base import Function, Metric, by_name, coordinate_unit, input_unit, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.summary import in_percent, written_out
from fpirhc.task.problem import Problem

_SMALLEST = 1e-12  # range of a reference
SETTLED = 0.02  # half width of the band, as a share of the reference's range or of the first error, whichever is larger
_AT = 1e-9  # of the range between the limits: nearer is at the limit
# A run of a simulated plant counts these even where they never occurred; the others are statuses of a machine.
_ALWAYS = (Status.OK, Status.NOT_CONVERGED, Status.INFEASIBLE, Status.HELD, Status.NON_FINITE)


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


def settling(problem: Problem, run: Run) -> dict[str, float]:
    """Return the time from which |error| stays within the band; 0 where it always is, NaN where the run ends outside it."""
    names, errors = run.layout["error"].elements, np.abs(run["true_error"])
    if run.stop is not None:
        return dict.fromkeys(names, np.nan)
    ranges = np.array([np.ptp(run[f"reference.{name}"]) for name in names])
    outside = errors > SETTLED * np.fmax(np.fmax(ranges, errors[0]), _SMALLEST)
    after = (outside * np.arange(1, run.cycles + 1)[:, None]).max(axis=0)
    return by_name(names, np.where(after < run.cycles, after * problem.period, np.nan))


def effort(problem: Problem, run: Run) -> dict[str, float]:
    """Return the rms command of every input."""
    commands = _measured(problem, run)
    return by_name(run.layout["command"].elements, np.sqrt(_mean(commands * commands)))


def total_variation(problem: Problem, run: Run) -> dict[str, float]:
    """Return sum |u_k+1 - u_k| per unit of time, by input."""
    commands = _measured(problem, run)
    moves = np.abs(np.diff(commands, axis=0)).sum(axis=0) / (max(len(commands) - 1, 1) * problem.period)
    return by_name(run.layout["command"].elements, moves if len(commands) else np.nan * moves)


def at_limit(problem: Problem, run: Run) -> float:
    """Return the share of the cycles in which a command, or its change, stands at a limit, clipped or planned there."""
    return float(_mean(np.asarray(at_limits(problem, run).any(axis=1))))


def at_limits(problem: Problem, run: Run) -> np.ndarray:
    """Return whether every command, or its change, stands at a limit in every measured cycle, shape (cycles, inputs)."""
    measured = measured_cycles(problem, run)
    lower, upper = (end[measured] for end in _limits(problem, run))
    span = upper - lower
    near = _AT * np.where(np.isfinite(span), span, np.fmax(1.0, np.fmin(np.abs(lower), np.abs(upper))))
    near, commands = np.where(np.isfinite(near), near, 0.0), _measured(problem, run)
    stands = (commands <= lower + near) | (commands >= upper - near)
    slowest, fastest = problem.period * np.array(problem.limits.rate_bounds(problem.plant))
    slack = 1e-6 * np.fmin(fastest, -slowest)
    moves, slack = np.diff(commands, axis=0, prepend=commands[:1]), np.where(np.isfinite(slack), slack, 0.0)
    stands |= (moves <= slowest + slack) | (moves >= fastest - slack)
    return np.asarray(stands)


def _measured(problem: Problem, run: Run) -> np.ndarray:
    """The commands of the measured cycles, shape (cycles, inputs)."""
    return run["command"].reshape(run.cycles, run.layout["command"].size)[measured_cycles(problem, run)]


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean over cycles; NaN where no cycle is measured."""
    return np.asarray(values.sum(axis=0) / len(values) if len(values) else np.full(values.shape[1:], np.nan))


def _limits(problem: Problem, run: Run) -> np.ndarray:
    """The limits of the inputs that were in force, shape (2, cycles, inputs)."""
    inputs = problem.plant.input.elements
    limits = np.array(problem.limits.input_bounds(problem.plant))
    limits = np.repeat(limits[:, None, :], run.cycles, axis=1)
    live = {f"limits.inputs.{name}.{end}": (end, k) for k, name in enumerate(inputs) for end in (0, 1)}
    for time, numbers in run.in_force:
        for path in live.keys() & numbers.keys():
            end, k = live[path]
            limits[end, round(time / problem.period) :, k] = numbers[path]
    return limits


def cycles(problem: Problem, run: Run) -> int:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of cycles."""
    return run.cycles


def status(problem: Problem, run: Run) -> dict[str, int]:  # noqa: ARG001 -- every metric is given the problem
    """Return the number of cycles of the whole run by status; that in which a run ended early counts as NON_FINITE."""
    counts = {s: int((run["status"] == s).sum()) for s in Status}
    counts[Status.NON_FINITE] += run.stop is not None
    return {s.name: count for s, count in counts.items() if count or s in _ALWAYS}


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


METRICS = (
    Metric("rms_error", rms_error, by="coordinate", unit=coordinate_unit, short="rms", headline=True, order=10),
    Metric("max_error", max_error, by="coordinate", unit=coordinate_unit, order=20),
    Metric("settling", settling, by="coordinate", unit=lambda problem, _: problem.time_unit, title="settled", order=40),
    Metric("effort", effort, by="input", unit=input_unit, better="neither", title="rms", order=50),
    Metric(
        "total_variation",
        total_variation,
        by="input",
        unit=lambda problem, name: derivative_unit(input_unit(problem, name), 1, problem.time_unit),
        better="neither",
        title="variation",
        headline=True,
        order=50,
    ),
    Metric("at_limit", at_limit, better="neither", title="at limit", text=in_percent, headline=True, order=50),
    Metric("cycles", cycles, better="neither", report=False, order=5),
    Metric("status", status, by="status", better="neither", report=False, order=80),
    Metric(
        "solve.median_iterations",
        _over("iterations", np.median),
        title="iterations",
        short="iter",
        text=iterations,
        order=90,
    ),
    Metric("solve.worst_iterations", _over("iterations", np.max), text=iterations, report=False, order=90),
    Metric(
        "solve.median_stationarity",
        _over("stationarity", np.median),
        text=lambda value: written_out(value, 1),
        title="residual",
        short="residual",
        report=False,
        order=90,
    ),
    Metric("solve.worst_stationarity", _over("stationarity", np.max), title="worst residual", order=90),
    Metric("solve.worst_feasibility", _over("feasibility", np.max), report=False, order=90),
    Metric("plans", plans, better="neither", report=False, order=90),
)
