"""The figure by which controllers are compared and tuned: the relative error, or any metric that has a better direction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fpirhc.errors import InvalidName, InvalidValue, derivative_of, nearest
from fpirhc.plant.motion import followed_units, with_space
from fpirhc.simulation.metrics import RELATIVE_ERROR, Metric
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

PENALTY = 10.0  # relative error that no run can exceed
_NO_METRIC = 1e12  # in its place for a metric, whose size is not known


@dataclass(frozen=True)
class Objective:
    """A number of every run: a column of the table of runs."""

    metric: Metric | None = None  # None: the relative rms error
    element: str = ""  # of the metric
    unit: str = ""  # of the number

    @property
    def column(self) -> str:
        """Its column in a table of runs."""
        return "error" if self.metric is None else self.metric.key(self.element)

    @property
    def sign(self) -> int:
        """-1 where larger is better: a number times it is better when it is smaller."""
        return -1 if self.metric is not None and self.metric.better == "larger" else 1

    def needed(self, metrics: Sequence[Metric]) -> list[Metric]:
        """Return the metrics that a study measures in every run."""
        return [one for one in metrics if one.always or one is self.metric]

    def text(self, value: float) -> str:
        """Return a number of a run as text."""
        if not math.isfinite(value):
            return "none"
        return in_percent(value) if self.metric is None else self.metric.text(value) + self._unit

    def difference(self, value: float) -> str:
        """Return a difference of two numbers as text."""
        return f"{100 * value:+.3g} %" if self.metric is None else f"{value:+.3g}{self._unit}"

    @property
    def _unit(self) -> str:
        return "" if self.unit in ("", "1") else with_space(self.unit)

    def value(self, row: Mapping[str, Any]) -> float:
        """Return the number of a row times `sign`: smaller is better, and infinite where the run failed or has none."""
        if row["outcome"] in ("ended early", "refused"):
            return math.inf
        if self.metric is not None and self.column not in row:
            names = [name for name in row if name.partition(".")[0] == self.metric.name]
            raise InvalidName(
                f"metric '{self.column}': a run of '{row['controller']}' has none.{nearest(self.column, names) if names else ''}"
            )
        value = self.sign * float(row[self.column])
        return value if math.isfinite(value) else math.inf

    def cost(self, row: Mapping[str, Any]) -> float:
        """Return a finite cost: one and two penalties for a run that failed, less where it lasted long."""
        value, most = self.value(row), PENALTY if self.metric is None else _NO_METRIC
        return min(value, most) if math.isfinite(value) else most * (2 - row["lasted"])


def objective(name: str | None, metrics: Sequence[Metric], problem: Problem) -> Objective:
    """Return the objective by the name of a number: None for the relative error, else 'at_limit' or 'overshoot.q1'.

    Raises:
        InvalidName: no such number; the nearest one is offered.
        InvalidValue: a metric without a better direction, or with a number for every element and none named.
    """
    if name is None or name in (RELATIVE_ERROR, "error"):
        return Objective()
    names: Any = {None: (), "coordinate": followed_units(problem.plant), "input": problem.plant.inputs}
    for metric in metrics:
        element = name.removeprefix(metric.name).removeprefix(".")
        if name != metric.key(element) or (element and element not in names.get(metric.by, (element,))):
            continue
        if metric.by is not None and not element:
            own = ", ".join(map(metric.key, names.get(metric.by, ("NAME",))))
            raise InvalidValue(f"metric '{metric.name}' has a number for every {metric.by}; give one: {own}")
        if metric.by == "term" and (problem.cost is None or problem.horizon is None):
            raise InvalidValue(f"metric '{name}' needs Problem(horizon=..., cost=...), and this problem lacks one")
        if metric.better == "neither":
            raise InvalidValue(f"metric '{name}' has no better direction, so nothing can be judged by it")
        return Objective(metric, element, metric.unit_of(problem, element))
    own = f"state.{derivative_of(name.rpartition('.')[2])}'"
    rate = f' For a derivative: metrics = [fp.figures.Largest("{own}")].' if own[6:-1] in names["coordinate"] else ""
    valid = [metric.key(one) for metric in metrics for one in names.get(metric.by) or ("",)]
    raise InvalidName(f"metric '{name}' is unknown.{rate}{nearest(name, [RELATIVE_ERROR, *valid])}")
