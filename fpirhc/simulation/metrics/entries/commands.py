"""The size of the commands, and the share of the cycles in which they were clipped."""

from __future__ import annotations

import numpy as np

from fpirhc.simulation.metrics.base import Metric
from fpirhc.simulation.metrics.window import by_name, input_unit, measured_cycles
from fpirhc.simulation.run import Run
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem


def effort(problem: Problem, run: Run) -> dict[str, float]:
    """Return the rms command of every input, from `measure_from` on; NaN where the run ended before."""
    commands = run["command"][measured_cycles(problem, run)]
    squares = np.mean(commands**2, axis=0) if commands.shape[0] else np.full(commands.shape[1], np.nan)
    return by_name(run.layout["command"].elements, np.sqrt(squares))


def clipped_share(problem: Problem, run: Run) -> float:  # noqa: ARG001 -- every metric is given the problem
    """Return the share of the cycles of the whole run with a clipped command."""
    return float(np.mean(run["clipped"])) if run.cycles else float("nan")


METRICS = (
    Metric("effort", effort, by="input", unit=input_unit, better="neither", title="rms", finite=True, order=50),
    Metric(
        "clipped_share",
        clipped_share,
        better="neither",
        title="clipped",
        text=in_percent,
        headline=True,
        finite=True,
        step=lambda _, cycles: 1.0 / cycles,
        order=60,
    ),
)
