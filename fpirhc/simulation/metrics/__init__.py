"""The contract of metrics: one value holds a number's name, function, appearance and comparison.

`METRICS` of `shipped` are those of every problem, `metrics = (...)` in a problem file its own.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from numbers import Integral, Real
from typing import Literal, SupportsIndex

import numpy as np

from fpirhc.errors import InvalidName, InvalidValue, nearest
from fpirhc.fields.checked import ByName, Checked, FoundByName, checked_call
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.summary import line, written_out
from fpirhc.symbolic.evaluate import attempted
from fpirhc.task.problem import Problem

Better = Literal["smaller", "larger", "neither"]
Function = Callable[[Problem, Run], float | Mapping[str, float] | None]

RELATIVE_ERROR = "relative error"  # by which controllers are compared where no metric is named
_NAME = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)?")


@dataclass(frozen=True, eq=False)
class Metric(Checked):
    """A number that sums up a run, or one number for every coordinate, input or term.

        overshoot = Metric("overshoot", function, by="coordinate", unit=lambda problem, name: problem.plant.coordinates[name])

    Args:
        name: small letters, digits and '_'; one dot may put it in a group, 'solve.worst_iterations'.
        function: (problem, run) -> a number, or with `by` a mapping with one number for every element; None where the run has no
            such number. NaN means that the run did not reach it.
        by: kind of the elements ('coordinate', 'input', 'term', ...); None for one number.
        unit: of every element: text, or a function (problem, element) -> text; the element of a single number is ''.
        better: direction of an improvement: 'smaller', 'larger' or 'neither'.
        title: heading in a report; '': the name.
        short: heading on a terminal; '': the heading in a report.
        text: function that writes a finite number.
        main: whether the metric stands in the short table of a comparison, where its best value is marked.
        report: whether the metric stands in the report's table.
        shown: the elements that stand in the report's table; None: all.
        floor: size of a difference up to which two numbers count as equal.
        order: place among the columns, smallest first; metrics of one place stand as they are listed.
        always: whether every run of a study has it; False: only where it is judged by, because it takes longer than the run.

    Raises:
        InvalidName: a name that cannot be a key.
        InvalidValue: an unknown direction.
    """

    name: str
    function: Function
    by: str | None = None
    unit: str | Callable[[Problem, str], str] = "1"
    better: Better = "smaller"
    title: str = ""
    short: str = ""
    text: Callable[[float], str] = written_out
    main: bool = False
    report: bool = True
    shown: tuple[str, ...] | None = None
    floor: float = 1e-12
    order: float = math.inf
    always: bool = True

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise InvalidName(
                f"metric {self.name!r}: expected a name of small letters, digits and '_', such as 'rms_error' or "
                "'solve.worst_iterations'"
            )

    def __reduce_ex__(self, protocol: SupportsIndex) -> str | tuple[object, ...]:
        """A known metric is pickled by its name, so that metrics of runs can come from other processes."""
        return (known_metric, (self.name,)) if known_metric(self.name) is self else super().__reduce_ex__(protocol)

    @property
    def heading(self) -> str:
        """Heading in a report."""
        return self.title or self.name.replace("_", " ").replace(".", " ")

    def key(self, element: str) -> str:
        """Return the name of one number in files: 'rms_error.q1', or the metric's name."""
        return f"{self.name}.{element}" if element else self.name

    def unit_of(self, problem: Problem, element: str) -> str:
        """Return the unit of one element."""
        return self.unit if isinstance(self.unit, str) else self.unit(problem, element)

    def values(self, problem: Problem, run: Run) -> dict[str, float]:
        """Return the numbers of a run by element, a single number under ''; empty where the run has none.

        Raises:
            InvalidValue: the function did not return numbers, or not in the form that `by` announces.
        """
        return self.numbers(self.function(problem, run))

    def numbers(self, result: object) -> dict[str, float]:
        """Return a result of the function as numbers by element; see `values`.

        Raises:
            InvalidValue: no numbers, or not in the form that `by` announces.
        """
        if result is None:
            return {}
        if isinstance(result, Mapping) != (self.by is not None):
            expected = "one number" if self.by is None else f"a mapping with a number for every {self.by}"
            got = type(result).__name__
            raise InvalidValue(f"metric '{self.name}': its function must return {expected}, got {got}")
        items = result.items() if isinstance(result, Mapping) else [("", result)]
        return {str(element): self._number(value) for element, value in items}

    def _number(self, value: object) -> float:
        """The value as a number; a count stays whole, so that files show a whole number."""
        if isinstance(value, Integral):
            return int(value)
        if isinstance(value, Real):
            return float(value)
        raise InvalidValue(f"metric '{self.name}': expected numbers, got {type(value).__name__}")


def measured_cycles(problem: Problem, run: Run) -> np.ndarray:
    """Return which cycles are measured, those from `measure_from` on; shape (cycles,), boolean."""
    return np.asarray(run.time >= problem.measure_from - 0.5 * problem.period)


def by_name(names: Sequence[str], values: np.ndarray) -> dict[str, float]:
    """Return numbers by name."""
    return {n: float(v) for n, v in zip(names, values, strict=True)}


def coordinate_unit(problem: Problem, coordinate: str) -> str:
    """Return the unit of a judged coordinate or output."""
    return problem.plant.followed[coordinate]


def input_unit(problem: Problem, name: str) -> str:
    """Return the unit of an input."""
    return problem.plant.inputs[name]


_TAKEN = frozenset({"compiled", "cycle_us", "notes", "optimality", "outcome", "plan", "statuses", "stop"})  # by files


@cache
def known_metrics() -> tuple[Metric, ...]:
    """Return the shipped metrics, in the order of their columns."""
    from fpirhc.simulation.metrics.shipped import METRICS

    return _ordered(METRICS)


def known_metric(name: str) -> Metric | None:
    """Return the known metric of this name, None without one."""
    return next((metric for metric in known_metrics() if metric.name == name), None)


def with_own_metrics(own: Iterable[Metric]) -> tuple[Metric, ...]:
    """Return the known metrics and the own ones of a problem file, in the order of their columns.

    Those of another problem file are its own and the known ones, which are not there twice.
    """
    known = known_metrics()
    return _ordered([*known, *(metric for metric in own if metric not in known)])


def _ordered(metrics: Iterable[Metric]) -> tuple[Metric, ...]:
    """The metrics in the order of their columns; raises where one name stands for two things in a file."""
    ordered = tuple(sorted(metrics, key=lambda metric: metric.order))
    counts = Counter(metric.name for metric in ordered)
    groups = {name.partition(".")[0] for name in counts if "." in name}
    for name, count in counts.items():
        if count > 1:
            raise InvalidName(f"metric '{name}' is defined {count} times; give yours another name")
        if name in groups or name.partition(".")[0] in _TAKEN:
            raise InvalidName(f"metric '{name}': the name has another meaning in results; give yours another one")
    return ordered


@dataclass(frozen=True)
class Metrics(FoundByName, Mapping[str, Mapping[str, float]]):
    """The metrics of one run: numbers by metric and element; a single number has the element ''.

        metrics["overshoot"]["q1"], metrics["at_limit"][""], metrics.rms_error["q1"]

    Args:
        numbers: what it is a mapping of. Metrics that the run does not have are left out.
        units: units by metric and element.
        entries: the metrics that were measured, by name.
        broken: sentences about those whose function raised an error, by name; they have no numbers.
    """

    numbers: Mapping[str, Mapping[str, float]]
    units: Mapping[str, Mapping[str, str]]
    entries: Mapping[str, Metric]
    broken: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Mapping[str, float]:
        if isinstance(name, str) and name in self.entries:
            return self.numbers.get(name) or ByName({}, f"Metrics[{name!r}]")
        raise InvalidName(f"metric '{name}' is unknown.{nearest(name, self.entries)}")

    def __iter__(self) -> Iterator[str]:
        return iter(self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    def rows(self) -> Iterator[tuple[Metric, str, float]]:
        """Yield every number as (metric, element, number)."""
        for name, numbers in self.items():
            for element, value in numbers.items():
                yield self.entries[name], element, value

    @property
    def rms_error(self) -> Mapping[str, float]:
        """Rms error by coordinate."""
        return self["rms_error"]

    @property
    def total_variation(self) -> Mapping[str, float]:
        """Movement of the command per unit of time, by input."""
        return self["total_variation"]

    @property
    def statuses(self) -> Mapping[str, int]:
        """Number of cycles by status, of the statuses that occurred."""
        return ByName({name: int(count) for name, count in self["status"].items() if count}, "Metrics.statuses")

    @property
    def worst_status(self) -> str:
        """The worst status that occurred."""
        return max((Status[name] for name in self.statuses), default=Status.OK, key=lambda s: s.severity).name

    def __repr__(self) -> str:
        facts = (f"{m.heading} {element} {m.text(value)}" for m, element, value in self.rows() if m.main)
        return line(self, *(" ".join(fact.split()) for fact in facts), f"worst {self.worst_status}")


@checked_call
def measure(problem: Problem, run: Run, metrics: Sequence[Metric] | None = None) -> Metrics:
    """Return the metrics of a run.

    Errors are reference minus the plant's state of the judged coordinates. Metrics use the cycles from `problem.measure_from` on
    unless the metric states otherwise; a run that ended before has NaN errors.

    Args:
        problem: that ran.
        run: of the problem.
        metrics: to measure, for a problem file its `task.metrics`; None: the shipped and the installed ones.

    Raises:
        InvalidValue: a metric's function returned no numbers.
    """
    entries = known_metrics() if metrics is None else metrics
    told: dict[str, list[str]] = {m.name: [] for m in entries}
    results = {m: attempted(f"metric '{m.name}'", m.function, problem, run, broken=told[m.name]) for m in entries}
    values = {m.name: numbers for m, result in results.items() if (numbers := m.numbers(result))}
    units = {m.name: {e: m.unit_of(problem, e) for e in values[m.name]} for m in entries if m.name in values}
    return Metrics(values, units, {m.name: m for m in entries}, {n: one[0] for n, one in told.items() if one})


@dataclass(frozen=True)
class Column:
    """One number of every run."""

    metric: Metric
    element: str  # of the metric; '' for a single number
    unit: str  # of the number

    @property
    def heading(self) -> str:
        """Heading in a report: 'rms error q1 [m]'."""
        return self._with_unit(self.metric.heading)

    @property
    def short(self) -> str:
        """Heading on a terminal."""
        return self._with_unit(self.metric.short or self.metric.heading)

    def number(self, metrics: Metrics) -> float | None:
        """Return the number of one run; None where the run has none, NaN where the run did not reach it."""
        return metrics[self.metric.name].get(self.element)

    def text(self, value: float | None, *, missing: str, none: str) -> str:
        """Return a number as text; `missing` for None, `none` for NaN."""
        return missing if value is None else none if math.isnan(value) else self.metric.text(value)

    def best(self, values: Iterable[float | None]) -> float | None:
        """Return the best number; None where no direction is better or there is no number."""
        finite = [v for v in values if v is not None and math.isfinite(v)]
        if not finite or self.metric.better == "neither":
            return None
        return min(finite) if self.metric.better == "smaller" else max(finite)

    def _with_unit(self, heading: str) -> str:
        named = f"{heading} {self.element}" if self.metric.by and self.metric.shown is None else heading
        return named if self.unit in ("", "1") else f"{named} [{self.unit}]"


def in_report(metric: Metric) -> bool:
    """Whether a metric stands in a report's table or in a short one."""
    return metric.report or metric.main


def columns(runs: Sequence[Metrics], wanted: Callable[[Metric], bool] = in_report) -> list[Column]:
    """Return the columns of a table of these runs and of the wanted metrics, without numbers that no run has."""
    shown: dict[tuple[str, str], Column] = {}
    for metrics in runs:
        for metric, element, _ in metrics.rows():
            if wanted(metric) and (metric.shown is None or element in metric.shown):
                shown.setdefault((metric.name, element), Column(metric, element, metrics.units[metric.name][element]))
    return sorted(shown.values(), key=lambda column: column.metric.order)
