"""The cost of a trial: the relative error, or any metric that has a better direction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fpirhc.errors import InvalidName, InvalidValue, nearest
from fpirhc.simulation.metrics import Metric

PENALTY = 10.0  # relative error that no run can exceed; one that ended early costs up to twice as much, less if it lasted long
RELATIVE_ERROR = "relative error"
_NO_METRIC = 1e12  # instead of `PENALTY` for a metric, whose size is not known


@dataclass(frozen=True)
class Objective:
    """The cost of one run.

    The cost is a number of the metric, with the opposite sign where larger is better. A run that ended early, or without the
    number, costs between one and two penalties, less if it lasted long.

    Args:
        metric: the metric; None: the relative rms error (see `score`).
        element: element of the metric.
    """

    metric: Metric | None = None
    element: str = ""

    @property
    def name(self) -> str:
        """The name in files."""
        return RELATIVE_ERROR if self.metric is None else self.metric.key(self.element)

    @property
    def refused(self) -> float:
        """Cost of settings that cannot run."""
        return 2 * self._penalty

    @property
    def _penalty(self) -> float:
        return PENALTY if self.metric is None else _NO_METRIC

    def cost(self, record: Mapping[str, Any]) -> float:
        """Return the cost of a scenario's record.

        Raises:
            InvalidName: a run that finished has no such number.
        """
        if "skipped" in record:
            return self.refused
        value = record["error"] if self.metric is None else self._number(record)
        if value is None:
            return float(self._penalty * (2 - record["lasted"]))
        return float(min(value, self._penalty))

    def _number(self, record: Mapping[str, Any]) -> float | None:
        assert self.metric is not None
        numbers = record["metrics"].get(self.metric.name, {})
        if self.element not in numbers and record["outcome"] == "finished":
            names = [self.metric.key(element) for element in numbers]
            raise InvalidName(
                f"metric '{self.name}': a run of '{record['controller']}' has none.{nearest(self.name, names)}"
            )
        value = None if record["outcome"] == "ended early" else numbers.get(self.element)
        return None if value is None else value * (-1 if self.metric.better == "larger" else 1)


def objective(name: str | None, metrics: Sequence[Metric]) -> Objective:
    """Return the objective by the name of a number: None for the relative error, else 'at_limit' or 'overshoot.q1'.

    Raises:
        InvalidName: an unknown metric.
        InvalidValue: one without a better direction, or with one number for every element.
    """
    if name is None or name == RELATIVE_ERROR:
        return Objective()
    for metric in metrics:
        element = name.removeprefix(metric.name).removeprefix(".")
        if name != metric.key(element):
            continue
        if metric.better == "neither":
            raise InvalidValue(f"metric '{metric.name}' has no better direction, so nothing can be tuned by it")
        if metric.by is not None and not element:
            raise InvalidValue(
                f"metric '{metric.name}' has a number for every {metric.by}; give one: '{metric.name}.NAME'"
            )
        return Objective(metric, element)
    raise InvalidName(f"metric '{name}' is unknown.{nearest(name, [RELATIVE_ERROR, *(m.name for m in metrics)])}")
