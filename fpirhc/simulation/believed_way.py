"""The plant of a null test: its commands reach it, and its response the controller, the way the deformation believes.

A lag or a dead time that a deformation believes is a part of its model, so a plant without it is no right model. A dead time that
the problem states is a fact, and stays.
"""

from __future__ import annotations

import math
from dataclasses import replace

from fpirhc.deformation.base import Deformation, Mirror
from fpirhc.errors import NotSupported
from fpirhc.plant.behind_actuators import behind_actuators
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.problem import Problem
from fpirhc.task.reality import Reality


def with_believed_way(problem: Problem, deformation: Deformation) -> Problem:
    """Return the problem of a right model; itself where the deformation believes nothing beyond the problem.

    A lag before a map, or before algebraic states, is left out.
    """
    mirror = deformation.mirror
    return problem if mirror is None else _with_lag(_with_dead_time(problem, mirror), mirror)


def _with_dead_time(problem: Problem, mirror: Mirror) -> Problem:
    cycles = _each(mirror.cycles, len(problem.plant.inputs))
    stated = problem.dead_time.measurement or any(problem.dead_time.inputs.values())
    if stated or not (any(cycles) or mirror.measurement):
        return problem
    inputs = {name: c * problem.period for name, c in zip(problem.plant.inputs, cycles, strict=True)}
    return replace(problem, dead_time=DeadTime(inputs=inputs, measurement=mirror.measurement * problem.period))


def _with_lag(problem: Problem, mirror: Mirror) -> Problem:
    lags = _each(mirror.lag, len(problem.plant.inputs))
    if not any(lags):
        return problem
    try:
        plant = behind_actuators(problem.plant, lags)
    except NotSupported:
        return problem
    finer = problem.integrator.finer(math.ceil(problem.period / min(t for t in lags if t)))
    return replace(problem, reality=Reality(plant, integrator=finer or problem.integrator))


def _each(value: float | tuple[float, ...], count: int) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,) * count
