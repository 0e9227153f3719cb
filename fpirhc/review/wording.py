"""Poles and times as an engineer writes them."""

from __future__ import annotations

import math

from fpirhc.task.problem import Problem


def per_cycle(pole: float, problem: Problem) -> str:
    """Return 'is multiplied by 0.976 per cycle (time constant 41 ms)'; without the time where the mode does not decay."""
    text = f"is multiplied by {pole:.6g} per cycle"
    return f"{text} (time constant {duration(-problem.period / math.log(pole), problem)})" if 0 < pole < 1 else text


def duration(time: float, problem: Problem) -> str:
    """Return a time in the problem's unit; a time of less than a second in ms or us."""
    unit = problem.time_unit
    if unit != "s" or not 0 < time < 1:
        return f"{time:.3g} {unit}"
    return f"{1e3 * time:.3g} ms" if time >= 1e-3 else f"{1e6 * time:.3g} us"
