"""What the cycles of a run read: disturbances, the random series of sensors, set-points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fpirhc.simulation.path import disturbance_values
from fpirhc.simulation.step_arguments import Setpoints, set_point_table
from fpirhc.task.problem import Problem


def run_tables(
    problem: Problem,
    seed: int,
    cycles: int,
    *,
    disturbed: bool = True,
    setpoints: Setpoints | None = None,
    later: Sequence[tuple[int, Problem]] = (),
) -> list[np.ndarray]:
    """Return what the loop reads in every cycle: disturbances, the sensors' random series, set-points, where there are any.

    Args:
        seed: of the noise of disturbances and sensors; each has its own stream.
        disturbed: whether disturbances act; the sensors' noise always does.
        later: (first cycle, problem) with other numbers of disturbances and sensors from a cycle on.
    """
    times, sensing, disturbances = np.arange(cycles) * problem.period, problem.sensing, problem.disturbances
    random = float(disturbed) * disturbance_values(problem, times, seed), sensing.table(times, seed)
    tables = [table for table in (*random, set_point_table(problem, setpoints, cycles)) if table.shape[1]]
    moved = [
        (cycle, other)
        for cycle, other in later
        if other.sensing is not sensing or other.disturbances is not disturbances
    ]
    for cycle, other in moved:
        changed = run_tables(other, seed, cycles, disturbed=disturbed, setpoints=setpoints)
        for table, rows in zip(tables, changed, strict=True):
            table[cycle:] = rows[cycle:]
    return tables
