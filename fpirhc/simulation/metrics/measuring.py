"""Measures a run by every metric: those of the folder `entries`, of installed packages, and of a problem file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points

from fpirhc.errors import InvalidName, nearest
from fpirhc.fields.checked import ByName, FoundByName, checked_call
from fpirhc.members import within
from fpirhc.simulation.metrics.base import Metric
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.summary import line, number, table
from fpirhc.symbolic.evaluate import attempted
from fpirhc.task.problem import Problem

GROUP = "fpirhc.metrics"  # of entry points; each leads to a Metric or to a tuple of them
# Files hold other facts of a run under these names.
_TAKEN = frozenset({"compiled", "cycle_us", "notes", "optimality", "outcome", "plan", "statuses", "stop"})


@cache
def known_metrics() -> tuple[Metric, ...]:
    """Return the shipped metrics and those of installed packages, in the order of their columns."""
    shipped = [
        metric for module in within("fpirhc.simulation.metrics.entries") for metric in getattr(module, "METRICS", ())
    ]
    installed = [metric for point in entry_points(group=GROUP) for metric in _several(point.load())]
    return _ordered([*shipped, *installed])


def known_metric(name: str) -> Metric | None:
    """Return the known metric of this name, None without one."""
    return next((metric for metric in known_metrics() if metric.name == name), None)


def with_own_metrics(own: Iterable[Metric]) -> tuple[Metric, ...]:
    """Return the known metrics and the own ones of a problem file, in the order of their columns.

    Those of another problem file are its own and the known ones, which are not there twice.
    """
    known = known_metrics()
    return _ordered([*known, *(metric for metric in own if metric not in known)])


def _several(loaded: Metric | Iterable[Metric]) -> Iterable[Metric]:
    return (loaded,) if isinstance(loaded, Metric) else loaded


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
class Metrics(FoundByName):
    """The metrics of one run.

        metrics["overshoot"]["q1"], metrics["at_limit"][""], metrics.rms_error["q1"]

    Args:
        values: numbers by metric and element; a single number has the element ''. Metrics that the run does not have are left out.
        units: units by metric and element.
        entries: the metrics that were measured, by name.
        broken: sentences about those whose function raised an error; they have no numbers.
    """

    values: Mapping[str, Mapping[str, float]]
    units: Mapping[str, Mapping[str, str]]
    entries: Mapping[str, Metric]
    broken: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> Mapping[str, float]:
        if isinstance(name, str) and name in self.entries:
            return self.values.get(name) or ByName({}, f"Metrics[{name!r}]")
        raise InvalidName(f"metric '{name}' is unknown.{nearest(name, self.entries)}")

    def __iter__(self) -> Iterator[tuple[Metric, str, float]]:
        """Yield every number as (metric, element, number)."""
        for name, numbers in self.values.items():
            for element, value in numbers.items():
                yield self.entries[name], element, value

    def text(self, name: str, element: str = "") -> str:
        """Return one number as text, as its metric writes it."""
        return self.entries[name].text(self[name][element])

    @property
    def rms_error(self) -> Mapping[str, float]:
        """Rms error by coordinate."""
        return self["rms_error"]

    @property
    def max_error(self) -> Mapping[str, float]:
        """Largest error by coordinate."""
        return self["max_error"]

    @property
    def iae(self) -> Mapping[str, float]:
        """Integral of |error| by coordinate."""
        return self["iae"]

    @property
    def settling(self) -> Mapping[str, float]:
        """Settling time by coordinate; NaN where the run did not settle."""
        return self["settling"]

    @property
    def effort(self) -> Mapping[str, float]:
        """Rms command by input."""
        return self["effort"]

    @property
    def total_variation(self) -> Mapping[str, float]:
        """Movement of the command per unit of time, by input."""
        return self["total_variation"]

    @property
    def at_limit(self) -> float:
        """Share of the cycles with a command at a limit."""
        return self["at_limit"][""]

    @property
    def cost(self) -> Mapping[str, float]:
        """Cost along the run by term, and 'total'; empty without a cost."""
        return self["cost"]

    @property
    def solve(self) -> Mapping[str, float]:
        """Median and worst values of iterations, stationarity and feasibility, and number of plans; empty without an optimiser."""
        group = {n.partition(".")[2]: v[""] for n, v in self.values.items() if n.startswith("solve.")}
        return ByName({**group, "plans": self["plans"][""]} if group else {}, "Metrics.solve")

    @property
    def statuses(self) -> Mapping[str, int]:
        """Number of cycles by status, of the statuses that occurred."""
        return ByName({name: int(count) for name, count in self["status"].items() if count}, "Metrics.statuses")

    @property
    def worst_status(self) -> str:
        """The worst status that occurred."""
        return max((Status[name] for name in self.statuses), default=Status.OK, key=lambda s: s.severity).name

    def __repr__(self) -> str:
        facts = (
            f"{metric.heading} {element} {metric.text(value)}" for metric, element, value in self if metric.headline
        )
        return line(self, *(" ".join(fact.split()) for fact in facts), f"worst {self.worst_status}")

    def _repr_html_(self) -> str:
        """All numbers as a table, for notebooks."""
        rows = [(f"{m.heading} {element}".strip(), number(v), self.units[m.name][element]) for m, element, v in self]
        return table("Metrics", ("metric", "value", "unit"), rows)


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
    broken: list[str] = []
    results = {m: attempted(f"metric '{m.name}'", m.function, problem, run, broken=broken) for m in entries}
    values = {m.name: numbers for m, result in results.items() if (numbers := m.numbers(result))}
    units = {m.name: {e: m.unit_of(problem, e) for e in values[m.name]} for m in entries if m.name in values}
    return Metrics(values, units, {m.name: m for m in entries}, tuple(broken))


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
        if value is None:
            return missing
        return none if math.isnan(value) else self.metric.text(value)

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
    return metric.report or metric.headline


def columns(runs: Sequence[Metrics], wanted: Callable[[Metric], bool] = in_report) -> list[Column]:
    """Return the columns of a table of these runs and of the wanted metrics, without numbers that no run has."""
    shown: dict[tuple[str, str], Column] = {}
    for metrics in runs:
        for metric, element, _ in metrics:
            if wanted(metric) and (metric.shown is None or element in metric.shown):
                shown.setdefault((metric.name, element), Column(metric, element, metrics.units[metric.name][element]))
    return sorted(shown.values(), key=lambda column: column.metric.order)
