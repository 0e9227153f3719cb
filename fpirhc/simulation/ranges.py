"""Physical ranges of states, checked along a run: a level below zero is a run that no plant would make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem

_SIGNALS = (
    "foreign",
    "reality_state",
    "plant_state",
    "state",
)  # where the moving state is logged: the first that a run has


@dataclass(frozen=True, eq=False)
class Ranges:
    """The ranges of the logged states of the plant that moves.

    Args:
        columns: of the log, shape (m,).
        lower: shape (m,).
        upper: shape (m,).
        names: of the states, with their units.
    """

    columns: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    names: tuple[tuple[str, str], ...]

    def first_outside(self, rows: np.ndarray) -> tuple[int, str] | None:
        """Return the first row of a log in which a state is outside, and which one; None where all are inside."""
        if not self.names:
            return None
        values = rows[:, self.columns]
        outside = (values < self.lower) | (values > self.upper)
        if not outside.any():
            return None
        row = int(np.argmax(outside.any(axis=1)))
        k = int(np.argmax(outside[row]))
        name, unit = self.names[k]
        reach = f"{self.lower[k]:g} to {self.upper[k]:g} {unit}"
        return row, f"state '{name}' is {values[row, k]:.6g} {unit}, outside its physical range of {reach}"


def ranges_of(problem: Problem, trace: Layout) -> Ranges:
    """Return the ranges of the plant that a run moves, at the columns where its states are logged."""
    signal = trace[next(name for name in _SIGNALS if name in trace)]
    first = trace.slice(signal.name).start
    named = [(n, ends) for n, ends in problem.real_plant.ranges.items() if n in signal.elements]
    places = [signal.elements.index(n) for n, _ in named]
    lower, upper = (np.array([ends[k] for _, ends in named], dtype=float) for k in (0, 1))
    units = tuple((n, signal.entry_units[k]) for (n, _), k in zip(named, places, strict=True))
    return Ranges(np.array([first + k for k in places], dtype=int), lower, upper, units)
