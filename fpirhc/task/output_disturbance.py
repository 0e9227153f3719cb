"""Disturbances of outputs: signals d that are a part of an output, y = h(x, p) + d(t).

They move no state. What is measured, judged and followed is y, so a controller is to hold y and not h. Derivatives of y have those
of d between its jumps, y^(k) = L^k h + d^(k): the response that a deformation sees has d^(r). At a jump of d the output jumps, and
its derivatives do not show it; an estimator that differentiates samples does. The response of a map of order 1 is a difference,
and so is what d adds to it. An error of a sensor, which is measured and not
judged, is `Sensor(noise=...)`.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.task.problem import Problem

SIGNAL = "disturbance"  # what a loop reads in every cycle
LOGGED = "output_disturbance"


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
    by_name = dict(zip(problem.disturbances, values, strict=True))
    for name, k in disturbance_columns(problem):
        if k and problem.plant.step is not None:
            values.append(np.diff(by_name[name], prepend=by_name[name][:1]) / problem.period)
        elif k:
            values.append(problem.disturbances[name].derivative(times, k))
    return np.column_stack(values) if values else np.zeros((len(times), 0))


def logged_signal(problem: Problem) -> Signal:
    """Return the signal of what disturbances add to y, y', ... below the responses."""
    output = problem.plant.output
    return Signal(LOGGED, output.elements, output.units)


def added(problem: Problem, disturbance: Expression) -> tuple[Expression, Expression]:
    """Return what disturbances add to y, y', ... below the responses, and to the controlled responses.

    Args:
        problem: with disturbed outputs.
        disturbance: value of `disturbance_signal`.
    """
    plant, orders = problem.plant, problem.disturbed_outputs
    values: Mapping[str, Expression] = dict(
        zip(disturbance_signal(problem).elements, ca.vertsplit(disturbance), strict=True)
    )
    own = {e: v for e, v in values.items() if e.rstrip("'") in orders}
    below = [own.get(e, 0) for e in plant.output.elements]
    return ca.vertcat(*below), ca.vertcat(*(own.get(n + "'" * orders.get(n, 0), 0) for n in plant.controlled_names))
