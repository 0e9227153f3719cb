"""What is summed up of a run cycle by cycle: its metrics, and whether a number left its range. No log is kept for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.errors import NoCode
from fpirhc.simulation.metrics import measure
from fpirhc.simulation.metrics.base import Metric, first_measured
from fpirhc.simulation.metrics.summed import Cycle, Measured, Summed, Term, some
from fpirhc.simulation.ranges import ranges_of
from fpirhc.simulation.run import Run, with_common_columns
from fpirhc.symbolic.layout import Layout
from fpirhc.task.problem import Problem

Values = dict[str, dict[str, float]]  # by metric and element


@dataclass(frozen=True, eq=False)
class Sums:
    """The sums of one loop.

    Args:
        trace: of the loop.
        metrics: in the order of their numbers.
        built: the problem of the loop.

    Raises:
        NoCode: a metric that reads whole runs.
    """

    trace: Layout
    metrics: tuple[Metric, ...]
    built: Problem

    def __post_init__(self) -> None:
        for metric in self.metrics:
            if metric.summed is None and metric.reads is None:
                raise NoCode(f"the metric '{metric.name}' reads whole runs")
        self.start(self.built)

    @property
    def size(self) -> int:
        """Numbers of the memory."""
        return self._places[-1]

    @property
    def kept(self) -> Layout:
        """The signals of which every cycle is kept, for metrics that are functions of them."""
        names = {name for metric in self._of_logs for name in metric.reads or ()}
        return Layout(tuple(s for s in self._common[0].signals if s.name in names))

    def start(self, problem: Problem) -> np.ndarray:
        """Return the memory before a run, shape (size,).

        Raises:
            NoCode: a metric needs what nobody knows before the run.
        """
        return np.concatenate(self._starts(problem))

    def function(self) -> ca.Function:
        """Function (memory, trace, [number of the cycle, whether it is measured]) -> (memory, kept)."""
        memory, trace, when = ca.SX.sym("m", self.size), ca.SX.sym("s", self.trace.size), ca.SX.sym("k", 2)
        layout, columns = self._common
        whole = ca.mtimes(ca.DM(ca.sparsify(ca.DM(columns.T))), trace)
        signals = {s.name: whole[layout.slice(s.name)] for s in layout.signals}
        cycle = Cycle(signals, when[0], when[1])
        parts = zip(self._all, ca.vertsplit(memory, self._places), strict=True)
        kept = [signals[s.name] for s in self.kept.signals]
        after = ca.vertcat(*(ca.densify(one.step(part, cycle)) for one, part in parts))
        return ca.Function("fpirhc_sums", [memory, trace, when], [after, ca.densify(ca.vertcat(*kept, ca.SX(0, 1)))])

    def values(
        self, problems: Sequence[Problem], seeds: Sequence[int], sums: np.ndarray, log: np.ndarray
    ) -> list[Values | None]:
        """Return the metrics of some runs; None for one that left a range.

        Args:
            problems: of the runs; all have one duration and one first measured cycle.
            seeds: of their noise.
            sums: last memories, shape (runs, size).
            log: what was kept, shape (runs, cycles, kept.size).
        """
        arrays, outside = self.columns(problems[0], sums)
        columns = {name: {e: v.tolist() for e, v in some.items()} for name, some in arrays.items()}  # None where masked
        runs = [
            Run(one.name, "", seed, one.period, self.kept, rows, None, True, {})
            for one, seed, rows in zip(problems, seeds, log, strict=True)
        ]
        return [None if outside[k] else self._row(k, problems[k], columns, run) for k, run in enumerate(runs)]

    def columns(self, problem: Problem, sums: np.ndarray) -> tuple[dict[str, Mapping[str, np.ndarray]], np.ndarray]:
        """Return the metrics that are summed up, by name and element, shape (runs,) each; and which runs left a range."""
        run = self._measured(problem)
        outside, *rest = np.split(sums, self._places[1:-1], axis=1)
        pairs = zip(self._summed, rest, strict=True)
        return {m.name: one.result(part, run) for (m, one), part in pairs}, outside[:, -1] != 0

    def _row(
        self, k: int, problem: Problem, columns: Mapping[str, Mapping[str, list[float | None]]], run: Run
    ) -> Values:
        """The metrics of the k-th run; `run` has what was kept of it."""
        of_logs = measure(problem, run, self._of_logs).values
        row: Values = {}
        for metric in self.metrics:
            if metric.name in columns:
                row[metric.name] = {e: one for e, v in columns[metric.name].items() if (one := v[k]) is not None}
            elif metric.name in of_logs:
                row[metric.name] = dict(of_logs[metric.name])
        return row

    def _starts(self, problem: Problem) -> list[np.ndarray]:
        run, starts = self._measured(problem), []
        for one, name in zip(self._all, ("ranges", *(metric.name for metric, _ in self._summed)), strict=True):
            start = one.start(run)
            if start is None:
                raise NoCode(f"'{name}' cannot be summed up: this problem does not say before a run what it needs")
            starts.append(start)
        return starts

    def _measured(self, problem: Problem) -> Measured:
        return Measured(problem, self._common[0], problem.cycles, first_measured(problem))

    @cached_property
    def _common(self) -> tuple[Layout, np.ndarray]:
        """What a run logs, and how it follows from the trace: shape (trace, log)."""
        return with_common_columns(self.trace, np.eye(self.trace.size))

    @cached_property
    def _summed(self) -> list[tuple[Metric, Summed]]:
        return [(m, m.summed) for m in self.metrics if m.summed is not None]

    @cached_property
    def _of_logs(self) -> list[Metric]:
        return [m for m in self.metrics if m.summed is None]

    @cached_property
    def _all(self) -> list[Summed]:
        return [self._outside, *(one for _, one in self._summed)]

    @cached_property
    def _places(self) -> list[int]:
        return [0, *np.cumsum([len(start) for start in self._starts(self.built)]).tolist()]

    @cached_property
    def _outside(self) -> Summed:
        """Whether some number lay outside its range."""
        columns, names = ranges_of(self.built, self.trace).columns.tolist(), self.trace.names

        def ends(run: Measured) -> np.ndarray | None:
            found = ranges_of(run.problem, self.trace)
            ends = dict(zip(found.columns.tolist(), zip(found.lower, found.upper, strict=True), strict=True))
            if not ends.keys() <= set(columns):
                return None
            return np.array([ends.get(c, (-np.inf, np.inf)) for c in columns]).reshape(-1, 2).T.ravel()

        def left(cycle: Cycle) -> Term:
            values, count = ca.vertcat(*(cycle[name] for name in names))[columns], len(columns)
            lower, upper = cycle.constants[:count], cycle.constants[count:]
            return some(ca.logic_or(values < lower, values > upper)) if columns else ca.SX(0)

        return Summed(names, ("",), left, lambda sums, _: sums, largest=True, all_cycles=True, constants=ends)
