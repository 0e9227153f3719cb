"""What the cycles of a run read: disturbances, the random series of sensors, and set-points."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.simulation.step_arguments import Setpoints, set_point_table
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.task.problem import Problem

SIGNAL = "disturbance"  # what a loop reads in every cycle
LOGGED = "output_disturbance"


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


def disturbance_columns(problem: Problem) -> tuple[tuple[str, int], ...]:
    """Return name and derivative of every column of the disturbances: first all names, then d', d'', ... of outputs."""
    orders = problem.disturbed_outputs
    higher = ((name, k) for name, order in orders.items() for k in range(1, order + 1))
    return (*((name, 0) for name in problem.disturbances), *higher)


def disturbance_signal(problem: Problem) -> Signal:
    """Return the signal that a loop reads: every disturbance, and the derivatives of those of outputs."""
    return Signal(SIGNAL, tuple(name + "'" * k for name, k in disturbance_columns(problem)))


def disturbance_values(problem: Problem, times: np.ndarray, seed: int) -> np.ndarray:
    """Return all columns at some times, shape (m, columns); each disturbance has its own stream."""
    streams = np.random.SeedSequence(seed).spawn(len(problem.disturbances))
    values = [
        one.values(times, np.random.default_rng(stream))
        for one, stream in zip(problem.disturbances.values(), streams, strict=True)
    ]
    for name, k in disturbance_columns(problem):
        if k:
            values.append(problem.disturbances[name].derivative(times, k))
    return np.column_stack(values) if values else np.zeros((len(times), 0))


def by_place(problem: Problem, disturbance: Expression) -> dict[str, Expression]:
    """Return what disturbances add by name."""
    return dict(zip(problem.disturbances, ca.vertsplit(disturbance), strict=False))


def added(problem: Problem, disturbance: Expression) -> tuple[Expression, Expression]:
    """Return what disturbances add to y, y', ... below the responses, and to the controlled responses."""
    plant, orders = problem.plant, problem.disturbed_outputs
    values = zip(disturbance_signal(problem).elements, ca.vertsplit(disturbance), strict=True)
    own = {e: v for e, v in values if e.rstrip("'") in orders}
    below = [own.get(e, 0) for e in plant.output.elements]
    return ca.vertcat(*below), ca.vertcat(*(own.get(n + "'" * orders.get(n, 0), 0) for n in plant.controlled_names))
