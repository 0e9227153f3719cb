"""What the cycles of a run read: disturbances, the random series of sensors, set-points."""

from __future__ import annotations

import numpy as np

from fpirhc.simulation.path import disturbance_values
from fpirhc.simulation.step_arguments import Setpoints, set_point_table
from fpirhc.task.problem import Problem


def run_tables(
    problem: Problem, seed: int, cycles: int, *, disturbed: bool = True, setpoints: Setpoints | None = None
) -> list[np.ndarray]:
    """Return what the loop reads in every cycle: disturbances, the sensors' random series, set-points, where there are any.

    Args:
        seed: of the noise of disturbances and sensors; each has its own stream.
        disturbed: whether disturbances act; the sensors' noise always does.
    """
    times = np.arange(cycles) * problem.period
    random = float(disturbed) * disturbance_values(problem, times, seed), problem.sensing.table(times, seed)
    return [table for table in (*random, set_point_table(problem, setpoints, cycles)) if table.shape[1]]
