"""The plausible range of a sample: what no working sensor shows.

For a controlled coordinate the range follows from the values that the problem itself names, v = (reference over the run, start,
limits of the state),

    centre +- 10 R,      R = max((max v - min v) / 2, |v| / 2),

and for its k-th derivative +- 10 R (2 / period)^k: the whole range in half a cycle. Where all v are zero there is no scale and no
range. Coordinates that are not controlled have none, because they may drift.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fpirhc.controllers.seeing import raw_signal
from fpirhc.errors import Mistakes
from fpirhc.sensing.base import response_names
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

_MARGIN = 10.0
_SAMPLES = 200  # instants at which the reference is looked at


def plausible_range(problem: Problem, own: Mapping[str, Interval] | None = None) -> dict[str, Interval]:
    """Return intervals by column of the sample: "state.q1", "state.q1'" or "realised.q1"; of a raw one "measured.q1".

    Of a plant with outputs they are those of its outputs, "output.y".

    Args:
        problem: the task.
        own: intervals by name, "q1", "q1'", or "q1''" for the response, that replace the automatic ones.

    Raises:
        InvalidProblem: a name that is unknown or not measured, or an interval that is none.
    """
    plant, ranges = problem.plant.face, {}
    columns = _columns(problem)
    _check(own or {}, columns)
    values = _values(problem)
    for k in plant.controlled_indices:
        name = plant.names[k]
        seen = values[name]
        size = max(np.ptp(seen) / 2, np.abs(seen).max() / 2)
        middle = (seen.max() + seen.min()) / 2
        for power in range(plant.orders[k] + 1):
            reach = float(_MARGIN * size * (2 / problem.period) ** power)
            column = columns.get(name + "'" * power)
            if column is not None and 0 < reach < np.inf:
                centre = float(middle) if power == 0 else 0.0
                ranges[column] = (centre - reach, centre + reach)
    return ranges | {columns[name]: interval for name, interval in (own or {}).items()}


def _columns(problem: Problem) -> dict[str, str]:
    """Column of the sample by the name of the measured quantity."""
    plant, raw = problem.plant, raw_signal(problem)
    if raw is not None:
        return dict(zip(raw.elements, raw.columns, strict=True))
    columns = {e: f"{plant.output.name}.{e}" for e in plant.output.elements}
    return columns | {
        n: f"realised.{c}" for n, c in zip(response_names(plant.face), plant.controlled_names, strict=True)
    }


def _values(problem: Problem) -> dict[str, np.ndarray]:
    """Values of every coordinate that the problem names: reference, start, and finite limits."""
    plant, function = problem.plant.face, problem.reference.function(problem.plant)
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    reference = np.array([np.asarray(function(t)[0].full()).ravel() for t in times])
    values = {}
    for name in plant.names:
        at = plant.state.elements.index(name)
        named = [*reference[:, at], problem.start_output[at], *problem.limits.states.get(name, ())]
        values[name] = np.array([v for v in named if np.isfinite(v)])
    return values


def _check(own: Mapping[str, Interval], columns: Mapping[str, str]) -> None:
    mistakes = Mistakes("plausible")
    mistakes.unknown("measured quantity", own, columns)
    for name, interval in own.items():
        try:
            lower, upper = (float(v) for v in interval)
        except (TypeError, ValueError):
            mistakes.add(f"'{name}' needs two numbers (lower, upper), got {interval!r}")
            continue
        if not lower < upper:
            mistakes.add(f"'{name}' needs lower < upper, got {interval!r}")
    mistakes.raise_if_any()
