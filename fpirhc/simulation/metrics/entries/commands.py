"""The commands: their size, how much they move, and the share of the cycles in which they stand at a limit."""

from __future__ import annotations

import numpy as np

from fpirhc.plant.motion import derivative_unit
from fpirhc.simulation.metrics.base import Metric, input_unit
from fpirhc.simulation.metrics.summed import Cycle, Measured, Summed, Term, some
from fpirhc.summary import in_percent
from fpirhc.symbolic.live import nominal

_AT = 1e-9  # of the range between the limits: nearer is at the limit


def _ends(run: Measured) -> np.ndarray:
    """Commands from which on an input is at a limit, lower ones first, a column for the run or for each of its cycles."""
    lower, upper = _limits(run)
    span = upper - lower
    near = _AT * np.where(np.isfinite(span), span, np.fmax(1.0, np.fmin(np.abs(lower), np.abs(upper))))
    near = np.where(np.isfinite(near), near, 0.0)
    return np.concatenate([lower + near, upper - near])


def _limits(run: Measured) -> np.ndarray:
    """The limits of the inputs that were in force, shape (2, inputs) or (2, inputs, cycles)."""
    inputs = run.problem.plant.input.elements
    limits = np.array(nominal(run.problem.limits).input_bounds(run.problem.plant))
    changes = () if run.run is None else run.run.in_force
    live = {f"limits.inputs.{name}.{end}": (end, k) for k, name in enumerate(inputs) for end in (0, 1)}
    if not any(path in live for _, numbers in changes for path in numbers):
        return limits
    limits = np.repeat(limits[:, :, None], run.cycles, axis=2)
    for time, numbers in changes:
        since = round(time / run.problem.period)
        for path in live.keys() & numbers.keys():
            limits[(*live[path], slice(since, None))] = numbers[path]
    return limits


def _at_end(cycle: Cycle) -> Term:
    command = cycle["command"]
    count = command.shape[0]
    return some((command <= cycle.constants[:count]) + (command >= cycle.constants[count:]))


_COMMAND = ("command",)
# The rms command of every input.
effort = Summed(_COMMAND, "command", lambda c: c["command"] * c["command"], lambda sums, run: np.sqrt(sums / run.count))
# sum |u_k+1 - u_k| per unit of time, by input.
total_variation = Summed(
    _COMMAND,
    "command",
    lambda c: c.begun * abs(c["command"] - c.before["command"]),
    lambda sums, run: sums / (max(run.count - 1, 1) * run.problem.period),
    before=_COMMAND,
)
# The share of the cycles in which a command stands at a limit, clipped or planned there.
at_limit = Summed(_COMMAND, ("",), _at_end, lambda sums, run: sums / max(run.count, 1), constants=_ends)


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
