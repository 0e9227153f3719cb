"""Set-points of a run: checked before it starts, and one row of numbers per cycle; and those of a step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import cast

import numpy as np

from fpirhc.controllers.reference_states import given_signals
from fpirhc.errors import InvalidName, InvalidShape, InvalidValue, nearest
from fpirhc.fields.given import described
from fpirhc.fields.kinds import named_entries, real_number
from fpirhc.fields.user_code import called
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Steps
from fpirhc.task.set_point import check_values, in_force, pairs

Setpoints = Mapping[
    str, Steps | Callable[[float], float]
]  # by coordinate: a number, pairs (time, set-point), function of the time
SetpointsNow = Mapping[str, float | Sequence[float]]  # by coordinate: a number, or one per node of the horizon
_FUNCTION = "a function of time"


def set_point_table(problem: Problem, setpoints: Setpoints | None, cycles: int) -> np.ndarray:
    """Return what the reference is given in every cycle, shape (cycles, entries); no entries for a reference without set-points.

    Raises:
        InvalidName: a coordinate without set-point; the nearest one is offered.
        InvalidValue: no steps, or a set-point that is not finite, or outside the range or the limits of its state.
    """
    signals, steps = given_signals(problem), _steps(problem, setpoints)
    if not signals:
        return np.zeros((cycles, 0))
    names = list(problem.plant.chains)
    windows = signals[0].size // len(names)
    step = problem.horizon.step if problem.horizon is not None else 0.0
    times = (np.arange(cycles) * problem.period)[:, None] + step * np.arange(windows)
    columns = [_values(problem, name, steps[name], times) for name in names]
    check_values(problem.plant, problem.limits, {n: c.ravel().tolist() for n, c in zip(names, columns, strict=True)})
    return np.stack(columns, axis=2).reshape(cycles, -1)


def set_point_record(problem: Problem, setpoints: Setpoints | None) -> dict[str, object]:
    """Return the set-points of a run as plain data: [[time, set-point], ...] by coordinate, or words for a function."""
    steps = _steps(problem, setpoints)
    return {n: _FUNCTION if callable(s) else [list(p) for p in pairs(n, s)] for n, s in steps.items()}


def set_points_now(problem: Problem, setpoints: SetpointsNow, before: np.ndarray) -> np.ndarray:
    """Return the row of one step: `before` with other set-points of some coordinates, shape (entries,).

    Raises:
        InvalidName: a coordinate without set-point; the nearest one is offered.
        InvalidShape: neither one number nor one per node.
        InvalidValue: a set-point that is not finite, or outside the range or the limits of its state.
    """
    _check_names(problem, setpoints)
    names = list(problem.plant.chains)
    rows = before.reshape(-1, len(names)).copy()
    for name, value in setpoints.items():
        numbers = _numbers(value)
        if numbers is None:
            raise InvalidValue(f"set-point of '{name}': expected a number, got {described(value)}")
        if numbers.size not in (1, len(rows)):
            wanted = "one number" if len(rows) == 1 else f"one number, or {len(rows)}: now and at every later node"
            raise InvalidShape(f"set-point of '{name}': expected {wanted}, got {numbers.size}")
        rows[:, names.index(name)] = numbers
    check_values(problem.plant, problem.limits, {n: rows[:, names.index(n)].tolist() for n in setpoints})
    return rows.ravel()


def _steps(problem: Problem, setpoints: Setpoints | None) -> Setpoints:
    given = {} if setpoints is None else setpoints
    _check_names(problem, given)
    return {**problem.reference.set_points, **given}


def _check_names(problem: Problem, setpoints: Mapping[str, object]) -> None:
    known = problem.reference.set_points
    for name in named_entries("setpoints", setpoints):
        if not known:
            raise InvalidName(
                f"set-point '{name}': the reference {type(problem.reference).__name__} is given none; use Setpoint(...)"
            )
        if name not in known:
            raise InvalidName(f"set-point '{name}' is unknown.{nearest(str(name), known)}")


def _values(problem: Problem, name: str, steps: Steps | Callable[[float], float], times: np.ndarray) -> np.ndarray:
    """Set-points of one coordinate at some times, of the same shape."""
    if not callable(steps):
        return in_force(pairs(name, steps), times, problem.period)
    what = f"set-points of '{name}': the function of time"
    given = [called(what, steps, float(t)) for t in times.ravel()]
    values = [real_number(one) for one in given]
    if None in values:
        wrong = given[values.index(None)]
        raise InvalidValue(f"{what} does not return a number, but {described(wrong)}")
    return np.array(values, dtype=float).reshape(times.shape)


def _numbers(value: object) -> np.ndarray | None:
    """One number, or several; None where something else is among them."""
    one = real_number(value)
    if one is not None:
        return np.array([one])
    several = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | np.ma.MaskedArray)
    numbers = [real_number(entry) for entry in cast(Sequence[object], value)] if several else [None]
    return None if None in numbers else np.array(numbers, dtype=float)
