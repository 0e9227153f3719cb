"""The commands: their size, how much they move, and the share of the cycles in which they stand at a limit."""

from __future__ import annotations

import numpy as np

from fpirhc.plant.motion import derivative_unit
from fpirhc.simulation.metrics.base import Metric, by_name, input_unit, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.summary import in_percent
from fpirhc.symbolic.live import nominal
from fpirhc.task.problem import Problem

_AT = 1e-9  # of the range between the limits: nearer is at the limit


def effort(problem: Problem, run: Run) -> dict[str, float]:
    """Return the rms command of every input, from `measure_from` on; NaN where the run ended before."""
    commands = _measured(problem, run)
    squares = np.mean(commands**2, axis=0) if commands.shape[0] else np.full(commands.shape[1], np.nan)
    return by_name(run.layout["command"].elements, np.sqrt(squares))


def total_variation(problem: Problem, run: Run) -> dict[str, float]:
    """Return sum |u_k+1 - u_k| over the time from `measure_from` on, per unit of time, by input; NaN where the run ended before."""
    commands = _measured(problem, run)
    sums = np.abs(np.diff(commands, axis=0)).sum(axis=0) if commands.shape[0] else np.full(commands.shape[1], np.nan)
    return by_name(run.layout["command"].elements, sums / max((commands.shape[0] - 1) * problem.period, problem.period))


def at_limit(problem: Problem, run: Run) -> float:
    """Return the share of the cycles from `measure_from` on in which a command stands at a limit, clipped or planned there."""
    commands = _measured(problem, run)
    if not commands.shape[0]:
        return float("nan")
    lower, upper = nominal(problem).limits.input_bounds(problem.plant)
    span = upper - lower
    near = _AT * np.where(np.isfinite(span), span, np.fmax(1.0, np.fmin(np.abs(lower), np.abs(upper))))
    near = np.where(np.isfinite(near), near, 0.0)
    return float(np.mean(((commands <= lower + near) | (commands >= upper - near)).any(axis=1)))


def _measured(problem: Problem, run: Run) -> np.ndarray:
    """Commands of the measured cycles, shape (cycles, inputs)."""
    return np.asarray(run["command"][measured_cycles(problem, run)])


METRICS = (
    Metric("effort", effort, by="input", unit=input_unit, better="neither", title="rms", finite=True, order=50),
    Metric(
        "total_variation",
        total_variation,
        by="input",
        unit=lambda problem, name: derivative_unit(input_unit(problem, name), 1, problem.time_unit),
        better="neither",
        title="moves",
        headline=True,
        finite=True,
        order=55,
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
        order=60,
    ),
)
