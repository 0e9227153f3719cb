"""Set-points that change in steps: pairs (time, set-point), each in force from its time until the next one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.given import described
from fpirhc.fields.kinds import real_number
from fpirhc.plant.plant import Plant
from fpirhc.task.limits import Limits
from fpirhc.task.reference import Steps

_LATE = 1e-9  # share of a cycle by which a time may be rounded


def pairs(name: str, steps: Steps) -> list[tuple[float, float]]:
    """Return the steps of one coordinate as pairs (time, set-point).

    Raises:
        InvalidValue: no number and no pairs of numbers; times that do not begin at 0 and increase.
    """
    entries = [(0.0, steps)] if not isinstance(steps, Sequence | np.ndarray) else list(steps)
    text = f"set-points of '{name}'"
    if not entries or any(not isinstance(e, Sequence | np.ndarray) or len(e) != 2 for e in entries):
        raise InvalidValue(f"{text}: expected a number, or pairs (time, set-point), got {steps!r}")
    numbers: list[tuple[float, float]] = []
    for entry in entries:
        time, value = map(real_number, entry)
        if time is None or value is None or not (math.isfinite(time) and math.isfinite(value)):
            raise InvalidValue(
                f"{text}: expected finite numbers, got {described(entry if len(entries) > 1 else steps)}"
            )
        numbers.append((time, value))
    times = [time for time, _ in numbers]
    if times[0] != 0 or any(later <= time for time, later in pairwise(times)):
        raise InvalidValue(f"{text}: the times must begin at 0 and increase, got {times}")
    return numbers


def in_force(steps: Sequence[tuple[float, float]], times: np.ndarray, period: float) -> np.ndarray:
    """Return the set-point at some times: a change counts from the first cycle at or after its time."""
    begins = np.array([time for time, _ in steps])
    values = np.array([value for _, value in steps])
    return values[np.searchsorted(begins, times + _LATE * period, side="right") - 1]


def check_steps(plant: Plant, limits: Limits, set_points: Mapping[str, Steps]) -> None:
    """Raise if some set-points are no steps, or can never be reached.

    Raises:
        InvalidValue: see `pairs` and `check_values`.
    """
    known = {name: steps for name, steps in set_points.items() if name in plant.chains}
    check_values(plant, limits, {name: [v for _, v in pairs(name, steps)] for name, steps in known.items()})


def check_values(plant: Plant, limits: Limits, values: Mapping[str, Sequence[float]]) -> None:
    """Raise if a set-point is not finite, or can never be reached.

    Raises:
        InvalidValue: all such set-points together, each with the range that it leaves.
    """
    mistakes = []
    for name, numbers in values.items():
        for value in dict.fromkeys(numbers):
            if not math.isfinite(value):
                mistakes.append(f"'{name}' is {value}, expected a finite number")
                continue
            for what, (low, high) in _ranges(plant, limits, name).items():
                if not low <= value <= high:
                    mistakes.append(f"'{name}' is {value:g}, outside its {what} of {low:g} to {high:g}")
    if mistakes:
        raise InvalidValue(f"set-points: {'; '.join(mistakes)}")


def _ranges(plant: Plant, limits: Limits, name: str) -> dict[str, tuple[float, float]]:
    """What a set-point of the coordinate must not leave: its physical range, and a limit that has no price."""
    ranges = {"physical range": plant.ranges[name]} if name in plant.ranges else {}
    if name in limits.states and name not in {*limits.soft, *limits.prices}:
        ranges["limits"] = limits.states[name]
    return ranges
