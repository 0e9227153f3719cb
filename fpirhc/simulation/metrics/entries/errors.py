"""Errors of the judged coordinates: reference minus the plant's state, from `measure_from` on."""

from __future__ import annotations

import numpy as np

from fpirhc.simulation.metrics.base import Metric, by_name, coordinate_unit, measured_errors
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem


def rms_error(problem: Problem, run: Run) -> dict[str, float]:
    """Return the root mean square of the error over the cycles, by coordinate."""
    return by_name(run.layout["error"].elements, np.sqrt(np.mean(measured_errors(problem, run) ** 2, axis=0)))


def max_error(problem: Problem, run: Run) -> dict[str, float]:
    """Return the largest size of the error, by coordinate."""
    return by_name(run.layout["error"].elements, np.max(np.abs(measured_errors(problem, run)), axis=0))


def iae(problem: Problem, run: Run) -> dict[str, float]:
    """Return the integral of the error's size over time, the sum over the cycles times the period, by coordinate."""
    sums = np.sum(np.abs(measured_errors(problem, run)), axis=0)
    return by_name(run.layout["error"].elements, sums * problem.period)


METRICS = (
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
