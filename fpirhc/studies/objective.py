"""The figure by which controllers are compared and tuned: the relative error, or any metric that has a better direction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fpirhc.errors import InvalidName, InvalidValue, nearest
from fpirhc.plant.motion import followed_units, with_space
from fpirhc.simulation.metrics import RELATIVE_ERROR, Metric, Metrics
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

PENALTY = 10.0  # relative error that no run can exceed; one that ended early costs up to twice as much, less if it lasted long
_NO_METRIC = 1e12  # instead of `PENALTY` for a metric, whose size is not known


@dataclass(frozen=True)
class Objective:
    """The figure of one run, and its cost.

    The cost is a number of the metric, with the opposite sign where larger is better. A run that ended early, or without the
    number, costs between one and two penalties, less if it lasted long.
    """

    metric: Metric | None = None  # the metric; None: the relative rms error (see `score`)
    element: str = ""  # element of the metric
    unit: str = ""  # of the number

    @property
    def name(self) -> str:
        """The name in files."""
        return RELATIVE_ERROR if self.metric is None else self.metric.key(self.element)

    @property
    def refused(self) -> float:
        """Cost of settings that cannot run."""
        return 2 * self._penalty

    @property
    def ranks(self) -> bool:
        """Whether one number is better than another."""
        return self.metric is None or self.metric.better != "neither"

    @property
    def _penalty(self) -> float:
        return PENALTY if self.metric is None else _NO_METRIC

    @property
    def noun(self) -> str:
        """What a sentence calls it."""
        return "error" if self.metric is None else self.name

    @property
    def subject(self) -> str:
        """The same with its article."""
        return "the error" if self.metric is None else self.name

    @property
    def better(self) -> str:
        """What a sentence calls an improvement."""
        return "larger" if self._sign < 0 else "smaller"

    @property
    def _sign(self) -> int:
        return -1 if self.metric is not None and self.metric.better == "larger" else 1

    def text(self, value: float) -> str:
        """Return a value as text, in the unit and with the sign of the metric."""
        if not math.isfinite(value):
            return "none"
        if self.metric is None:
            return in_percent(value)
        return self.metric.text(self._sign * value) + self._unit

    @property
    def is_share(self) -> bool:
        """Whether its texts are in percent."""
        return self.metric is None or self.metric.text is in_percent

    @property
    def drawn_unit(self) -> str:
        """Unit of what is drawn; '' where there is none."""
        return "%" if self.is_share else self._unit.strip()

    def drawn(self, value: float) -> float:
        """Return a value as pictures have it: as `told`, and in percent where its text is."""
        return (100 if self.is_share else 1) * self.told(value)

    def told(self, value: float) -> float:
        """Return a value with the sign that the metric has; what is infinite is not a number."""
        return self._sign * value if math.isfinite(value) else math.nan

    def told_interval(self, low: float, high: float) -> tuple[float, float]:
        """Return the ends of an interval of differences so, the lower one first."""
        ends = (self.told(low), self.told(high))
        return ends if self._sign > 0 else ends[::-1]

    def amount(self, value: float) -> float:
        """Return a value so, for a ratio: a run that failed has nothing of what is to be large, and infinitely much of the rest."""
        return 0.0 if self._sign < 0 and math.isinf(value) else self._sign * value

    def difference(self, value: float) -> str:
        """Return a difference of two values as text."""
        if not math.isfinite(value):
            return "worse by a failure" if value > 0 else "better by a failure"
        shown = (100 if self.metric is None else self._sign) * value + 0.0
        return f"{shown:+.3g}" + (" %" if self.metric is None else self._unit)

    def interval(self, low: float, high: float) -> str:
        """Return an interval of differences as text, the smaller number first."""
        return " to ".join(map(self.difference, (low, high)[:: self._sign]))

    @property
    def _unit(self) -> str:
        return "" if self.unit in ("", "1") else with_space(self.unit)

    def of(self, metrics: Metrics) -> float:
        """Return the metric's number of one run with the sign that makes smaller better; infinite where it has none."""
        assert self.metric is not None
        value = self._sign * metrics[self.metric.name].get(self.element, math.nan)
        return value if math.isfinite(value) else math.inf

    def value(self, record: Mapping[str, Any]) -> float:
        """Return the number of a scenario's record with the sign that makes smaller better; infinite where the run failed."""
        value = record["error"] if self.metric is None else self._number(record)
        return math.inf if value is None else float(value)

    def cost(self, record: Mapping[str, Any]) -> float:
        """Return the cost of a scenario's record."""
        if "skipped" in record:
            return self.refused
        value = self.value(record)
        return min(value, self._penalty) if math.isfinite(value) else float(self._penalty * (2 - record["lasted"]))

    def check(self, controller: str, numbers: Mapping[str, object]) -> None:
        """Raise unless the metric's numbers of a run that finished have this one, be it NaN."""
        if self.metric is not None and self.element not in numbers:
            names = [self.metric.key(element) for element in numbers]
            lacking = (
                nearest(self.name, names) if names else " 'fpirhc run' shows the numbers that it has, and what raised."
            )
            raise InvalidName(f"metric '{self.name}': a run of '{controller}' has none.{lacking}")

    def _number(self, record: Mapping[str, Any]) -> float | None:
        assert self.metric is not None
        numbers = record["metrics"].get(self.metric.name, {})
        if record["outcome"] == "finished":
            self.check(record["controller"], numbers)
        value = None if record["outcome"] == "ended early" else numbers.get(self.element)
        return None if value is None else value * self._sign


def objective(name: str | None, metrics: Sequence[Metric], problem: Problem) -> Objective:
    """Return the objective by the name of a number: None for the relative error, else 'at_limit' or 'overshoot.q1'."""
    found = figure(name, metrics, problem)
    if not found.ranks:
        raise InvalidValue(f"metric '{name}' has no better direction, so nothing can be judged by it")
    return found


def figure(name: str | None, metrics: Sequence[Metric], problem: Problem) -> Objective:
    """Return the same of any number of a run, such as 'effort.F' or 'status.OK', also where none is better than another."""
    if name is None or name == RELATIVE_ERROR:
        return Objective()
    for metric in metrics:
        element = name.removeprefix(metric.name).removeprefix(".")
        if name != metric.key(element):
            continue
        if metric.by is not None and not element:
            raise InvalidValue(
                f"metric '{metric.name}' has a number for every {metric.by}; give one: '{metric.name}.NAME'"
            )
        if metric.by == "term" and (problem.cost is None or problem.horizon is None):
            raise InvalidValue(
                f"metric '{name}' needs Problem(horizon=..., cost=...), and this problem lacks one of them"
            )
        elements = _elements(metric, problem)
        if elements and element not in elements:
            raise InvalidName(f"metric '{name}' is unknown.{nearest(name, [metric.key(one) for one in elements])}")
        return Objective(metric, element, metric.unit_of(problem, element))
    raise InvalidName(f"metric '{name}' is unknown.{nearest(name, [RELATIVE_ERROR, *(m.name for m in metrics)])}")


def _elements(metric: Metric, problem: Problem) -> list[str]:
    """Names of the metric's numbers where the problem alone decides them; none where the run does."""
    return list({"coordinate": followed_units(problem.plant), "input": problem.plant.inputs}.get(metric.by or "", ()))
