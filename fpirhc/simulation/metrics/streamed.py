"""Metrics that are summed up cycle by cycle, for runs that keep no log.

A run's number is then a function of a small memory, which every cycle changes: the sum of the squares for an rms error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Cycle:
    """One cycle, in symbols.

    Args:
        signals: what a run logs, by name, each a column.
        number: of the cycle, from 0.
        measured: 1 from `measure_from` on, else 0.
    """

    signals: Mapping[str, ca.SX]
    number: ca.SX
    measured: ca.SX

    def __getitem__(self, name: str) -> ca.SX:
        return self.signals[name]


@dataclass(frozen=True, eq=False)
class Measured:
    """Which cycles of a run are measured.

    Args:
        problem: of the run.
        layout: of what it logs.
        cycles: of the run.
        first: the first one that is measured.
    """

    problem: Problem
    layout: Layout
    cycles: int
    first: int

    @property
    def count(self) -> int:
        """Number of measured cycles, at least one."""
        return self.cycles - self.first


@dataclass(frozen=True, eq=False)
class Streamed:
    """How a metric is summed up; its numbers are those of its function to rounding."""

    # of a run, its first memory, shape (n,), with the constants that its cycles need; None where the problem does not say
    # before a run what they are
    start: Callable[[Measured], np.ndarray | None]
    step: Callable[[ca.SX, Cycle], ca.SX]  # (memory, cycle) -> memory
    # (last memories, shape (runs, n), their runs) -> numbers by element, each of shape (runs,); a masked number is none
    result: Callable[[np.ndarray, Measured], Mapping[str, np.ndarray]]


def summed(
    signal: str,
    names: str,
    term: Callable[[ca.SX], ca.SX],
    number: Callable[[np.ndarray, Measured], np.ndarray],
    joined: Callable[[ca.SX, ca.SX], ca.SX] = lambda before, now: before + now,
) -> Streamed:
    """Return the sum of a term of every entry of a signal over the measured cycles, a number for each.

    Args:
        joined: (what is remembered, term of this cycle) -> what is remembered; starts at zero.
    """
    return Streamed(
        start=lambda run: np.zeros(run.layout[signal].size),
        step=lambda memory, cycle: joined(memory, cycle.measured * term(cycle[signal])),
        result=lambda sums, run: dict(zip(run.layout[names].elements, number(sums, run).T, strict=True)),
    )
