"""Parts that metrics of errors and commands share: the measured part of a run, and numbers by name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fpirhc.plant.motion import followed_units
from fpirhc.simulation.run import Run
from fpirhc.task.problem import Problem


def measured_cycles(problem: Problem, run: Run) -> np.ndarray:
    """Return which cycles are measured, those from `measure_from` on; shape (cycles,), boolean."""
    return np.asarray(run.time >= problem.measure_from - 0.5 * problem.period)


def measured_errors(problem: Problem, run: Run) -> np.ndarray:
    """Return the true errors of the measured cycles, shape (cycles, coordinates).

    A run that ended early, or before `measure_from`, has one row of NaN.
    """
    errors = run["true_error"][measured_cycles(problem, run)]
    if run.stop is not None or not errors.shape[0]:
        return np.full((1, errors.shape[1]), np.nan)
    return np.asarray(errors)


def by_name(names: Sequence[str], values: np.ndarray) -> dict[str, float]:
    """Return numbers by name."""
    return {n: float(v) for n, v in zip(names, values, strict=True)}


def coordinate_unit(problem: Problem, coordinate: str) -> str:
    """Return the unit of a judged coordinate or output."""
    return followed_units(problem.plant)[coordinate]


def input_unit(problem: Problem, name: str) -> str:
    """Return the unit of an input."""
    return problem.plant.inputs[name]
