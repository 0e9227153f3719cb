"""Limits of inputs and states by name; whatever is not named is free."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fpirhc.errors import Mistakes
from fpirhc.plant import Plant

Interval = tuple[float, float]


@dataclass(frozen=True)
class Limits:
    """Intervals (lower, upper): of inputs by name, and of states by name (q1, q1', ...).

    Input limits are kept by the plant's actuator (clipping). State limits bind an optimiser's plan.
    """

    inputs: Mapping[str, Interval] = field(default_factory=dict)
    states: Mapping[str, Interval] = field(default_factory=dict)

    def check(self, plant: Plant) -> None:
        """Raise if a name is unknown or an interval is empty.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("limits")
        mistakes.unknown("input", self.inputs, plant.inputs)
        mistakes.unknown("state", self.states, plant.state.elements)
        for name, interval in [*self.inputs.items(), *self.states.items()]:
            if not isinstance(interval, Sequence) or len(interval) != 2:
                mistakes.add(f"'{name}' needs two numbers (lower, upper), got {interval!r}")
            elif any(math.isnan(v) for v in interval) or interval[0] > interval[1]:
                mistakes.add(f"'{name}' has lower {interval[0]} above upper {interval[1]}; swap them")
        mistakes.raise_if_any()

    def input_bounds(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of every input, shape (nu,) each; infinite where free."""
        return _bounds(self.inputs, plant.input.elements)

    def state_bounds(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of every state, shape (nx,) each; infinite where free."""
        return _bounds(self.states, plant.state.elements)


def _bounds(intervals: Mapping[str, Interval], names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    free = (-math.inf, math.inf)
    pairs = np.array([intervals.get(n, free) for n in names], dtype=float).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]
