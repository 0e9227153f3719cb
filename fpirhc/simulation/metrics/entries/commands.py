"""The commands: their size, how much they move, and the share of the cycles in which they stand at a limit."""

from __future__ import annotations

import numpy as np

from fpirhc.plant.motion import derivative_unit
from fpirhc.simulation.metrics.base import Metric, by_name, input_unit, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

_AT = 1e-9  # of the range between the limits: nearer is at the limit


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


METRICS = (
    Metric("effort", effort, by="input", unit=input_unit, better="neither", title="rms", finite=True, order=50),
    Metric(
        "total_variation",
        total_variation,
        by="input",
        unit=lambda problem, name: derivative_unit(input_unit(problem, name), 1, problem.time_unit),
        better="neither",
        title="variation",
        headline=True,
        finite=True,
        order=50,
    ),
    Metric(
        "at_limit",
        at_limit,
        better="neither",
        title="at limit",
        text=in_percent,
        headline=True,
        finite=True,
        step=lambda _, cycles: 1.0 / cycles,
        order=50,
    ),
)
