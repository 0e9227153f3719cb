"""Metrics of several runs as columns of a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from fpirhc.simulation.metrics.base import Metric
from fpirhc.simulation.metrics.measuring import Metrics


@dataclass(frozen=True)
class Column:
    """One number of every run.

    Args:
        metric: the metric.
        element: of the metric; '' for a single number.
        unit: of the number.
    """

    metric: Metric
    element: str
    unit: str

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
