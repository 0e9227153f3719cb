"""Statistics of one controller over many paired scenarios, record after record, in memory that does not grow with them."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fpirhc.simulation.metrics import Metric, known_metrics
from fpirhc.studies.scenarios.paired import Quantiles, Record, Summary, median_interval
from fpirhc.studies.tuning.objective import Objective

_OF_METRICS = 2048  # numbers in a buffer of a metric, which has no interval beside it
_SHOWN = 4096  # scenarios at most whose errors are kept


def summarise(
    name: str,
    records: Iterable[Record],
    baseline: Iterable[Record] | None,
    seed: int,
    metrics: Sequence[Metric] | None = None,
    figure: Objective | None = None,
) -> Summary:
    """Return the summary of one controller's records against the baseline's of the same scenarios, in the same order.

    Without a baseline it is that of the baseline itself, without metrics that of the shipped and the installed ones, and without a
    figure that of the relative error. The seed is that of the resampling.
    """
    running = _Running(known_metrics() if metrics is None else metrics, figure or Objective())
    for record, before in zip(
        records, itertools.repeat(None) if baseline is None else baseline, strict=baseline is not None
    ):
        running.add(record, before)
    return running.summary(name, None if baseline is None else seed)


class _Running:
    """What was seen of the records so far."""

    def __init__(self, metrics: Sequence[Metric], figure: Objective) -> None:
        self._figure, self._error = figure, Objective()
        self._values, self._differences, self._ratios = Quantiles(), Quantiles(), Quantiles()
        self._numbers = {m.name: _Numbers(m.better) for m in metrics}
        self._shown = _Shown()
        self._outcomes, self._statuses = Counter[str](), Counter[str]()
        self._better = self._equal = 0
        self._worst, self._worst_of = -math.inf, ("", 0)
        self._first_ended: int | None = None

    def add(self, record: Record, before: Record | None) -> None:
        value, error = self._figure.value(record), self._error.value(record)
        other = value if before is None else self._figure.value(before)
        self._values.add(value)
        self._differences.add(0.0 if value == other else value - other)
        self._ratios.add(_ratio(value, other))
        self._better += value < other
        self._equal += before is not None and value == other
        number = int(record["scenario"])
        if value > self._worst or not self._shown.count:
            self._worst, self._worst_of = value, (str(record.get("name", number)), number)
        if self._first_ended is None and record["outcome"] == "ended early":
            self._first_ended = number
        self._shown.add((number, error, value, record["mismatch"]))
        self._outcomes[str(record["outcome"])] += 1
        for metric, numbers in record["metrics"].items():
            if metric in self._numbers:
                self._numbers[metric].add(numbers)
        self._statuses.update(record["metrics"]["status"])

    def summary(self, name: str, seed: int | None) -> Summary:
        """The summary; without a seed that of the baseline."""
        scenarios, errors, values, mismatch = self._shown.columns()
        count, low = self._values.count, self._values.at((self._values.count - 1) // 2)
        with np.errstate(invalid="ignore"):
            away = np.where(values == low, 0.0, np.abs(values - low))
        worst = {metric: one.worst(count) for metric, one in self._numbers.items() if one.directed}
        medians = {metric: one.medians(count) for metric, one in self._numbers.items()}
        approximate = [self._values, self._differences, *(q for one in self._numbers.values() for q in one.quantiles)]
        return Summary(
            name=name,
            count=count,
            scenarios=scenarios.astype(int),
            errors=errors,
            values=values,
            mismatch=mismatch,
            rank_error=max(one.error / one.count for one in approximate),
            median=self._values.median,
            median_scenario=int(scenarios[int(np.nanargmin(away))]),
            worst=self._worst,
            worst_scenario=self._worst_of[1],
            worst_name=self._worst_of[0],
            first_ended=self._first_ended,
            metrics={metric: one for metric, one in medians.items() if one},
            worst_metrics={metric: one for metric, one in worst.items() if one},
            outcomes=dict(self._outcomes),
            statuses=dict(+self._statuses),
            difference=None if seed is None else median_interval(self._differences, seed),
            ratio=self._ratios.median,
            better=self._better,
            equal=self._equal,
        )


class _Numbers:
    """The numbers of one metric by element; a run without the number counts as worse than any other."""

    def __init__(self, better: str) -> None:
        self.directed, self._larger = better != "neither", better == "larger"
        self._lacking = -math.inf if self._larger else math.inf
        self._by_element: dict[str, Quantiles] = {}
        self._worst: dict[str, float] = {}

    @property
    def quantiles(self) -> Iterable[Quantiles]:
        return self._by_element.values()

    def add(self, numbers: Mapping[str, float | None]) -> None:
        for element, number in numbers.items():
            if element not in self._by_element:
                self._by_element[element], self._worst[element] = Quantiles(room=_OF_METRICS), -self._lacking
            value = self._lacking if number is None else number
            self._by_element[element].add(value)
            self._worst[element] = (min if self._larger else max)(self._worst[element], value)

    def worst(self, count: int) -> dict[str, float]:
        """The worst numbers of so many runs."""
        return {e: float(v if self._by_element[e].count == count else self._lacking) for e, v in self._worst.items()}

    def medians(self, count: int) -> dict[str, float]:
        """The medians of so many runs."""
        for one in self._by_element.values():
            while one.count < count:
                one.add(self._lacking)
        return {element: one.median for element, one in self._by_element.items()}


class _Shown:
    """Rows of all scenarios, or of every second, fourth and so on."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._every, self.count = 1, 0

    def add(self, row: tuple[float, ...]) -> None:
        if self.count % self._every == 0:
            if len(self._rows) >= _SHOWN:
                self._rows, self._every = self._rows[::2], 2 * self._every
            if self.count % self._every == 0:
                self._rows.append(row)
        self.count += 1

    def columns(self) -> Iterable[np.ndarray]:
        return np.array(self._rows, dtype=float).T


def _ratio(after: float, before: float) -> float:
    if after == before:
        return 1.0
    if before == 0:
        return math.copysign(math.inf, after) * math.copysign(1.0, before)
    ratio = after / before
    return 1.0 if math.isnan(ratio) else ratio
