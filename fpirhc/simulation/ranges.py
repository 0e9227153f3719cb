"""What ends a run: physical ranges of states, errors of a loop that has run away, and signals that are not finite.

A level below zero is a run that no plant would make. An error of a million times the reference is no result of a controller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fpirhc.status import STOPPED, Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem

_Entries: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[str, str]]]
_RUNAWAY = 1e6  # times the largest value of the reference, or of the start
_INSTANTS = 200  # of the reference
_MOTIONS: Latest[np.ndarray] = Latest(4)  # of references
_ERRORS = ("true_error", "error")  # where they are logged: the first that a run has
# where the moving state is logged: the first that a run has
_SIGNALS = ("foreign", "reality_state", "plant_state", "state")
_DIVERGED = 1e100  # size of numbers that no loop but a diverging one has


@dataclass(frozen=True, eq=False)
class Ranges:
    """Where logged numbers must be, and what is said of one that is not."""

    columns: np.ndarray  # of the log, shape (m,)
    lower: np.ndarray  # shape (m,)
    upper: np.ndarray  # shape (m,)
    words: tuple[tuple[str, str], ...]  # (before, behind) a number that is outside

    def first_outside(self, rows: np.ndarray) -> tuple[int, str] | None:
        """Return the first row of a log in which a number is outside, and which one; None where all are inside."""
        if not self.words:
            return None
        values = rows[:, self.columns]
        outside = (values < self.lower) | (values > self.upper)
        if not outside.any():
            return None
        row = int(np.argmax(outside.any(axis=1)))
        k = int(np.argmax(outside[row]))
        before, behind = self.words[k]
        return row, f"{before} {values[row, k]:.6g} {behind}"


def ranges_of(problem: Problem, trace: Layout) -> Ranges:
    """Return the physical ranges of the plant that a run moves, and what errors may be, at the columns where they are logged."""
    states, errors = _of_states(problem, trace), _of_errors(problem, trace)
    columns, lower, upper = (np.concatenate([a, b]) for a, b in zip(states[:3], errors[:3], strict=True))
    return Ranges(columns.astype(int), lower, upper, (*states[3], *errors[3]))


def physical_ranges(problem: Problem, trace: Layout) -> Ranges:
    """Return the physical ranges alone, for what a body outside gives: one absurd sample is no loop that runs away."""
    columns, lower, upper, words = _of_states(problem, trace)
    return Ranges(columns, lower, upper, tuple(words))


def _of_states(problem: Problem, trace: Layout) -> _Entries:
    signal = trace[next(name for name in _SIGNALS if name in trace)]
    first = trace.slice(signal.name).start
    named = [(n, ends) for n, ends in problem.real_plant.ranges.items() if n in signal.elements]
    places = [signal.elements.index(n) for n, _ in named]
    lower, upper = (np.array([ends[k] for _, ends in named], dtype=float) for k in (0, 1))
    words = []
    for (name, (low, high)), k in zip(named, places, strict=True):
        unit = signal.entry_units[k]
        words.append((f"state '{name}' is", f"{unit}, outside its physical range of {low:g} to {high:g} {unit}"))
    return np.array([first + k for k in places], dtype=int), lower, upper, words


def _of_errors(problem: Problem, trace: Layout) -> _Entries:
    """Errors that no reference explains: the loop has run away, whatever its signals still are."""
    signal = trace[next(name for name in _ERRORS if name in trace)]
    plant, first = problem.plant, trace.slice(signal.name).start
    function = problem.reference.function(plant)

    def moved() -> np.ndarray:
        times = np.linspace(0.0, problem.duration, _INSTANTS)
        return np.asarray(function.map(_INSTANTS)(times[None, :])[0].full())

    motion = _MOTIONS.of((function,), (problem.duration,), moved)
    places, sizes, words = [], [], []
    for k, name in enumerate(signal.elements):
        row = plant.output.elements.index(name)
        along = np.append(motion[row], problem.start_output[row])
        size = float(np.abs(along[np.isfinite(along)]).max(initial=0.0))
        if size > 0:
            places.append(first + k)
            sizes.append(_RUNAWAY * size)
            unit = signal.entry_units[k]
            words.append(
                (
                    f"the error of '{name}' is",
                    f"{unit}, more than a million times the {size:.3g} {unit} of its reference and start",
                )
            )
    return np.array(places, dtype=int), -np.array(sizes), np.array(sizes), words


class Dropped:
    """The rows of a log, and what ends a run in them: signals that are not finite, and numbers beyond all sense.

    What a controller computes in a cycle of status NON_FINITE reaches neither the plant nor its memory: that step was dropped, what
    it logged shows its last finite values, and the run goes on.
    """

    def __init__(self, loop: Composite) -> None:
        """Find the columns that the step behind the gate writes."""
        traces: list[Layout] = [block.inside.trace for block in loop.blocks if block.inside is not None]
        names = {name for trace in traces for name in trace.names} & set(loop.trace.names)
        self._own = np.zeros(loop.trace.size, dtype=bool)
        for name in names - {STOPPED}:
            self._own[loop.trace.slice(name)] = True
        self._status = loop.trace.slice("status").start if "status" in names else None

    def first_bad(self, rows: np.ndarray, before: np.ndarray | None) -> tuple[int, int] | None:
        """Return row and column of the first value that ends a run; None where there is none.

        What is not finite in dropped steps gets the value of the row before, in place.

        Args:
            rows: of the log, shape (cycles, columns).
            before: the row before the first; None: there is none, and zeros are shown.
        """
        # A sum is finite only if every summand is, and it is fast; where it is not, the entries are checked one by one.
        with np.errstate(all="ignore"):
            if abs(np.sum(rows)) < _DIVERGED:
                return None
        for k, row in enumerate(rows):
            bad = ~np.isfinite(row)
            dropped = self._status is not None and row[self._status] == int(Status.NON_FINITE)
            if dropped and not (np.abs(row[~bad]) > _DIVERGED).any() and not (bad & ~self._own).any():
                last = rows[k - 1] if k else before
                row[bad] = 0.0 if last is None else last[bad]
            elif dropped or bad.any():
                return k, int(np.argmax(bad) if bad.any() else np.argmax(np.abs(row)))
        return None
