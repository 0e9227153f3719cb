"""Metrics that are sums over cycles, each written once: of a whole log, and cycle by cycle for runs that keep none.

A run's number is a function of a few sums, or largest terms, such as the sum of the squares for an rms error. A term is written
with operators of numbers and of symbols alike; a log is then one cycle with as many columns as it has cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import TypeAlias, cast

import casadi as ca
import numpy as np

from fpirhc.simulation.run import Run
from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem

Term: TypeAlias = ca.SX  # of one cycle, or an array with a column for each: operators are all that is used of both


@dataclass(frozen=True, eq=False)
class Cycle:
    """One cycle in symbols, or those of a log side by side.

    Args:
        signals: what a run logs, by name, each a column.
        number: of the cycle, from 0.
        measured: 1 from `measure_from` on, else 0.
        before: signals of the cycle before; zero in the first one.
        first: signals of the first cycle.
        begun: whether the cycle before is measured.
        constants: of the metric, a column.
    """

    signals: Mapping[str, Term]
    number: Term
    measured: Term
    before: Mapping[str, Term] = field(default_factory=dict)
    first: Mapping[str, Term] = field(default_factory=dict)
    begun: Term | int = 0
    constants: Term = field(default_factory=ca.SX)

    def __getitem__(self, name: str) -> Term:
        return self.signals[name]


def larger(one: Term, other: Term | float) -> Term:
    """Return the larger of two columns, entry by entry."""
    return (ca.fmax if isinstance(one, ca.SX) or isinstance(other, ca.SX) else np.fmax)(one, other)


def some(entries: Term) -> Term:
    """Return whether some entry of each column is not zero."""
    return ca.sum1(entries) > 0 if isinstance(entries, ca.SX) else np.any(entries, axis=0, keepdims=True)


@dataclass(frozen=True, eq=False)
class Measured:
    """Which cycles of a run are measured.

    Args:
        problem: of the run.
        layout: of what it logs.
        cycles: of the run.
        first: the first one that is measured.
        run: the run, where there is a log of it.
    """

    problem: Problem
    layout: Layout
    cycles: int
    first: int
    run: Run | None = None

    @property
    def count(self) -> int:
        """Number of measured cycles; at least one of a run without a log."""
        return self.cycles - self.first

    @property
    def stopped(self) -> bool:
        """Whether the run ended early."""
        return self.run is not None and self.run.stop is not None


def _none(run: Measured) -> np.ndarray | None:  # noqa: ARG001 -- as those that a metric has
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class Summed:
    """A metric's function (problem, run) -> its numbers, and the same without a log, by `start`, `step` and `result`.

    Args:
        reads: signals that the term reads.
        names: of the term's entries, or the signal whose elements they are; ('',) for a single number.
        term: of a cycle, a column that is not negative.
        number: (sums of the terms over the cycles, shape (runs, terms), their runs) -> numbers of the same shape.
        largest: whether the largest term counts in place of the sum.
        all_cycles: whether those before `measure_from` count too.
        of_whole_runs: whether a run that ended early has NaN.
        before: signals that the term reads of the cycle before.
        first: signals that it reads of the first cycle.
        constants: of a run, which the term needs; a column for each cycle where a log has changes; None where nobody knows
            them before it.
    """

    reads: tuple[str, ...]
    names: str | tuple[str, ...]
    term: Callable[[Cycle], Term]
    number: Callable[[np.ndarray, Measured], np.ndarray]
    largest: bool = False
    all_cycles: bool = False
    of_whole_runs: bool = False
    before: tuple[str, ...] = ()
    first: tuple[str, ...] = ()
    constants: Callable[[Measured], np.ndarray | None] = _none

    def __call__(self, problem: Problem, run: Run) -> float | Mapping[str, float]:
        """Return the numbers of a logged run; NaN where it has no cycle that counts."""
        values = self.values(problem, run)
        return values[""] if self.names == ("",) else values

    def values(self, problem: Problem, run: Run) -> dict[str, float]:
        """Return the same by element, a single number under ''."""
        first = int(np.sum(run.time < problem.measure_from - 0.5 * problem.period))
        about = Measured(problem, run.layout, run.cycles, first, run)
        names, begin = self._elements(run.layout), 0 if self.all_cycles else first
        none = (begin == run.cycles and not self.all_cycles) or (self.of_whole_runs and about.stopped)
        sums = np.full((1, len(names)), np.nan) if none else self._of_log(about, run, begin, len(names))
        numbers = dict(zip(names, self.number(sums, about)[0], strict=True))
        return {name: value.item() for name, value in numbers.items() if value is not np.ma.masked}

    def _elements(self, layout: Layout) -> tuple[str, ...]:
        return layout[self.names].elements if isinstance(self.names, str) else self.names

    def _of_log(self, about: Measured, run: Run, begin: int, terms: int) -> np.ndarray:
        rows = {name: run[name].reshape(run.cycles, run.layout[name].size).T for name in self.reads}
        before = {name: np.roll(rows[name], 1, axis=1)[:, begin:] for name in self.before}
        first = {name: rows[name][:, :1] for name in self.first}
        number = np.arange(begin, run.cycles)
        constants = self.constants(about)
        assert constants is not None
        held = constants[:, begin:] if constants.ndim > 1 else constants[:, None]
        some = {name: values[:, begin:] for name, values in rows.items()}
        cycle = cast(Callable[..., Cycle], Cycle)(some, number, 1, before, first, number > about.first, held)
        entries = np.broadcast_to(self.term(cycle), (terms, len(number)))
        return np.asarray(entries.max(axis=1, initial=0.0) if self.largest else entries.sum(axis=1))[None]

    def start(self, run: Measured) -> np.ndarray | None:
        """Return the first memory: constants, signals of the cycle before, first ones, whether it counts, sums.

        None where nobody knows the constants before the run.
        """
        constants, kept = self.constants(run), (*self.before, *self.first)
        count = sum(run.layout[name].size for name in kept) + 1 + len(self._elements(run.layout))
        return None if constants is None else np.append(constants, np.zeros(count))

    def step(self, memory: ca.SX, cycle: Cycle) -> ca.SX:
        """Return the memory after a cycle."""
        terms = cycle[self.names].numel() if isinstance(self.names, str) else len(self.names)
        sizes = [*(cycle[name].numel() for name in (*self.before, *self.first)), 1, terms]
        ends = accumulate(sizes, initial=memory.numel() - sum(sizes))
        constants, *kept, begun, sums = ca.vertsplit(memory, [0, *ends])
        before = dict(zip(self.before, kept, strict=False))
        pairs = zip(self.first, kept[len(before) :], strict=True)
        first = {name: ca.if_else(cycle.number == 0, cycle[name], value) for name, value in pairs}
        term = self.term(replace(cycle, before=before, first=first, begun=begun, constants=constants))
        now = term if self.all_cycles else cycle.measured * term
        after = ca.fmax(sums, now) if self.largest else sums + now
        return ca.vertcat(constants, *(cycle[name] for name in self.before), *first.values(), cycle.measured, after)

    def result(self, memories: np.ndarray, run: Measured) -> dict[str, np.ndarray]:
        """Return the numbers by element, of shape (runs,), from the last memories (runs, n); a masked number is none."""
        names = self._elements(run.layout)
        return dict(zip(names, self.number(memories[:, -len(names) :], run).T, strict=True))
