"""Problems with other dead times, for questions about a dead time that is not known exactly."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from fpirhc.task.dead_time import MEASUREMENT
from fpirhc.task.problem import Problem

_WHOLE = 1e-9  # of a cycle


def scaled(problem: Problem, percent: float) -> Problem:
    """Return the problem with all dead times longer by so many percent, rounded away from the true one to whole cycles.

    A fraction of a cycle is interpolated between two commands, which damps requests that alternate.
    """
    rounded: Callable[[float], int] = math.ceil if percent > 0 else math.floor
    sign = _WHOLE if percent > 0 else -_WHOLE

    def changed(time: float) -> float:
        return rounded(time / problem.period * (1 + percent / 100) - sign) * problem.period

    times = problem.dead_time
    inputs = {name: changed(time) for name, time in times.inputs.items()}
    return replace(problem, dead_time=replace(times, inputs=inputs, measurement=changed(times.measurement)))


def roomy(problem: Problem, percent: float) -> Problem:
    """Return the problem with queues for dead times that are longer by so many percent, as `scaled` makes them."""
    times, most = problem.dead_time, scaled(problem, percent).dead_time
    longest = {**most.inputs, MEASUREMENT: most.measurement}
    stated = {n: max(t, times.longest.get(n, 0.0)) for n, t in longest.items() if n in times.queued}
    return replace(problem, dead_time=replace(times, longest={**times.longest, **stated}))


def live_paths(problem: Problem) -> tuple[str, ...]:
    """Return the paths of the dead times of a problem with queues for other ones."""
    times = problem.dead_time
    inputs = tuple(f"dead_time.inputs.{name}" for name in times.inputs if name in times.longest)
    return (*inputs, "dead_time.measurement") if MEASUREMENT in times.longest else inputs


def is_late(problem: Problem) -> bool:
    """Whether there is a dead time."""
    return bool(problem.dead_time.measurement or any(problem.dead_time.inputs.values()))
