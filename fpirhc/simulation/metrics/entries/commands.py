"""The commands: their size, how much they move, and the share of the cycles in which they stand at a limit."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.plant.motion import derivative_unit
from fpirhc.simulation.metrics.base import Metric, by_name, input_unit, measured_cycles
from fpirhc.simulation.metrics.streamed import Cycle, Measured, Streamed, summed
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
    lower, upper = _ends(problem)
    return float(np.mean(((commands <= lower) | (commands >= upper)).any(axis=1)))


def _ends(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Commands from which on an input is at a limit, shape (inputs,) each."""
    lower, upper = nominal(problem.limits).input_bounds(problem.plant)
    span = upper - lower
    near = _AT * np.where(np.isfinite(span), span, np.fmax(1.0, np.fmin(np.abs(lower), np.abs(upper))))
    near = np.where(np.isfinite(near), near, 0.0)
    return lower + near, upper - near


def _measured(problem: Problem, run: Run) -> np.ndarray:
    """Commands of the measured cycles, shape (cycles, inputs)."""
    return np.asarray(run["command"][measured_cycles(problem, run)])


def _moving(memory: ca.SX, cycle: Cycle) -> ca.SX:
    """Sums, the last commands, and whether these were measured."""
    command = cycle["command"]
    sums, last, begun = ca.vertsplit(memory, [0, command.numel(), 2 * command.numel(), memory.numel()])
    return ca.vertcat(sums + begun * ca.fabs(command - last), command, cycle.measured)


def _moved(memories: np.ndarray, run: Measured) -> dict[str, np.ndarray]:
    names, time = run.layout["command"].elements, max((run.count - 1) * run.problem.period, run.problem.period)
    return dict(zip(names, memories.T[: len(names)] / time, strict=True))


def _standing(memory: ca.SX, cycle: Cycle) -> ca.SX:
    """The ends, and the number of cycles at them."""
    command, count = cycle["command"], memory[-1]
    lower, upper = ca.vertsplit(memory[:-1], command.numel())
    standing = ca.logic_or(command <= lower, command >= upper)
    some = ca.sum1(standing) > 0
    return ca.vertcat(lower, upper, count + cycle.measured * some)


METRICS = (
    Metric(
        "effort",
        effort,
        by="input",
        unit=input_unit,
        better="neither",
        title="rms",
        finite=True,
        order=50,
        streamed=summed("command", "command", lambda u: u * u, lambda sums, run: np.sqrt(sums / run.count)),
    ),
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
        streamed=Streamed(lambda run: np.zeros(2 * run.layout["command"].size + 1), _moving, _moved),
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
        streamed=Streamed(
            lambda run: np.concatenate([*_ends(run.problem), [0.0]]),
            _standing,
            lambda memories, run: {"": memories[:, -1] / run.count},
        ),
    ),
)
