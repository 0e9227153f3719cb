"""The result of paired scenarios, and what every output says of it: the verdict, a table of controllers, facts."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import chain, islice, zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from fpirhc.errors import InvalidName, nearest
from fpirhc.fields.checked import FoundByName
from fpirhc.simulation.metrics.base import Column as Number
from fpirhc.simulation.pictures.base import Picture
from fpirhc.studies.objective import Objective
from fpirhc.studies.scenarios.bench import RecordFields
from fpirhc.studies.scenarios.paired import Record, Summary, counted, noun
from fpirhc.studies.view import Study, View, status_shares
from fpirhc.summary import Column, Table, in_percent, in_units, line, written_out

if TYPE_CHECKING:
    import pandas as pd

_ERRORS = "Errors are rms errors divided by the range of the reference, root mean square over the judged coordinates. "
_MEANING = (
    "Every scenario has the same noise, disturbances and parameters for all controllers; differences are taken within scenarios, "
    "and their intervals are 95 % percentile bootstrap intervals of the median. A run whose error exceeds the reference's range, "
    "and where the reference is held that of the plant left alone, has diverged; a run that ended early counts as worse than every "
    "other run."
)
FIELDS = tuple(one.name for one in fields(RecordFields) if one.name != "metrics")
_UNTUNED = "No file of tuned settings was given: all settings are those of the problem file."


@dataclass(frozen=True, eq=False, kw_only=True)
class ScenarioComparison(Study, FoundByName):
    """The result of `compare_scenarios`.

    Args:
        count: number of scenarios.
        named: whether they are cases of the problem file.
        figure: by which controllers are compared.
        groups: summaries of the scenarios of every group, the baseline first.
        percent: range of the exact parameters' draws, percent.
        seed: of all draws.
        measure_from: time from which errors count.
        columns: columns of the summaries' metrics in a short table.
        summaries: summaries in the controllers' order, the baseline first.
        records: records of the scenarios, by controller; they are read from the folder of the study where they are asked for.
        skipped: reasons why controllers were not run, by name.
        verdict: the verdict in sentences.
        tuning: sentences about the origin of tuned settings, by controller.
        time_unit: unit of time of the problem.
        pictures: those of the problem file; they are drawn where they keep something of every run.
        apart: why runs of some controllers were one after the other, and not side by side.
        to_look_at: options of `fpirhc run` for some scenarios, by controller and what they are.
        units: units of the numbers of records, by 'metric.element'.
    """

    count: int
    percent: float
    seed: int
    measure_from: float
    columns: Sequence[Number]
    summaries: tuple[Summary, ...]
    records: Mapping[str, Sequence[Record]]
    skipped: Mapping[str, str]
    verdict: tuple[str, ...]
    tuning: Mapping[str, str]
    time_unit: str = "s"
    named: bool = False
    figure: Objective = field(default_factory=Objective)
    groups: Mapping[str, tuple[Summary, ...]] = field(default_factory=dict)
    pictures: tuple[Picture, ...] = ()
    apart: Mapping[str, str] = field(default_factory=dict)
    to_look_at: Mapping[str, Mapping[str, Sequence[str]]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        counts = counted(self.count, noun(self.named)), f"{len(self.summaries)} controllers", f"seed {self.seed}"
        return line(self, self.problem, *counts, self.verdict[0])

    def to_dataframe(self) -> pd.DataFrame:
        """Return a row per controller and scenario as a pandas DataFrame: numbers of a metric in columns 'rms_error.q1'.

        `attrs["units"]` has the units of columns that have one, by name.
        """
        import pandas as pd

        frames = list(self.frames())
        whole = pd.concat(frames, ignore_index=True)
        whole.attrs = frames[0].attrs
        return whole

    def frames(self, rows: int = 10_000) -> Iterator[pd.DataFrame]:
        """Return `to_dataframe` in parts of so many rows, for a study that is larger than the memory; one part may be empty."""
        import pandas as pd

        left, first = self._every(), True
        while (part := list(islice(left, rows))) or first:
            facts = {name: [one[name] for one in part] for name in FIELDS}
            numbers = [_flat(one["metrics"]) for one in part]
            metrics = {name: np.array([some.get(name) for some in numbers], dtype=float) for name in self.units}
            yield in_units(pd.DataFrame({**facts, **metrics}).astype({"error": float}), self.units)
            first = False

    def _every(self) -> Iterator[Record]:
        return chain.from_iterable(self.records.values())

    @property
    def view(self) -> View:
        return _view(self)

    def __getitem__(self, name: str) -> Summary:
        for summary in self.summaries:
            if summary.name == name:
                return summary
        raise InvalidName(f"controller '{name}' is not here.{nearest(name, [s.name for s in self.summaries])}")


def _view(comparison: ScenarioComparison) -> View:
    """Return what is said of paired scenarios."""
    drawn = f", exact parameters within {comparison.percent:g} % of the problem's"
    conditions = (
        f"{counted(comparison.count, noun(comparison.named))} of seed {comparison.seed}{'' if comparison.named else drawn}, "
        f"errors from t = {comparison.measure_from:g} {comparison.time_unit} on."
    )
    rank_error = max((one.rank_error for one in comparison.summaries), default=0.0)
    if rank_error:
        conditions += (
            f" Medians are from {in_percent(0.5 - rank_error)} to {in_percent(0.5 + rank_error)} of the order."
        )
    # The first sentences are about the rivals, in their order.
    outcomes = [one.outcome for one in comparison.summaries[1:]]
    return comparison.viewed(
        sentences=tuple(zip_longest(comparison.verdict, outcomes)),
        conditions=f"{conditions} {'' if comparison.figure.metric else _ERRORS}{_MEANING} {'' if comparison.tuning else _UNTUNED}",
        tables=(_controllers(comparison, conditions), _groups(comparison)),
        lists={
            "Tuning": [f"{name}: {note}" for name, note in comparison.tuning.items()],
            "How it was run": [
                f"{name}: one run after the other, because {why}" for name, why in comparison.apart.items()
            ],
            f"{noun(comparison.named).capitalize()} to look at": list(_to_look_at(comparison)),
        },
        skipped=comparison.skipped,
        facts=_facts(comparison),
    )


def _to_look_at(comparison: ScenarioComparison) -> Iterator[str]:
    """The commands that run them once more, with every signal."""
    task = shlex.split(comparison.command)[2] if comparison.command else comparison.problem
    for name, some in comparison.to_look_at.items():
        for what, options in some.items():
            yield f"{name}, {what}: {shlex.join(['fpirhc', 'run', task, name, *options])}"


def _flat(metrics: Mapping[str, Mapping[str, float | None]]) -> dict[str, float | None]:
    """Numbers by 'metric.element', and by 'metric' where there is one number."""
    return {f"{name}.{e}" if e else name: value for name, some in metrics.items() for e, value in some.items()}


def _controllers(comparison: ScenarioComparison, conditions: str) -> Table:
    """The controllers, what is worst of them first."""
    figure, directed = comparison.figure, [c for c in comparison.columns if c.metric.better != "neither"]
    # a terminal has room for few: those of a file that judges by a figure, such as the lowest value beside the time in a range
    beside = [c for c in directed if figure.metric and c.metric.headline and c.metric is not figure.metric]
    heads = (
        Column("controller"),
        Column(f"worst {figure.noun}", "worst"),
        Column(f"in {noun(comparison.named).removesuffix('s')}", "in" if comparison.named else None),
        Column("failures", "failed"),
        *(Column(f"worst {c.short}", "" if c in beside else None) for c in directed),
        Column(f"median {figure.noun}", "median"),
        Column("difference (95 %)"),
        Column("ratio"),
        Column(f"{figure.better} in", None),
        *(Column(f"median {c.short}", None) for c in comparison.columns),
        Column("status", None, left=True),
    )
    title = f"{comparison.problem}: {counted(comparison.count, noun(comparison.named))}"
    table = Table(title, heads, conditions)
    for one in comparison.summaries:
        worst = [_number(c, one.worst_metrics) for c in directed]
        medians = [_number(c, one.metrics) for c in comparison.columns]
        compared = [figure.text(one.median), *_beside(one, figure)]
        table.add([one.name, *_worst(one, figure), *worst, *compared, *medians, status_shares(one.statuses)])
    return table


def _groups(comparison: ScenarioComparison) -> Table:
    """The same in short for every group."""
    figure = comparison.figure
    heads = (
        "group",
        "controller",
        f"worst {figure.noun}",
        "in case",
        "failures",
        f"median {figure.noun}",
        "difference (95 %)",
        "ratio",
    )
    table = Table("Groups", [*map(Column, heads), Column(f"{figure.better} in")], names=2)
    for name, summaries in comparison.groups.items():
        for one in summaries:
            table.add([name, one.name, *_worst(one, figure), figure.text(one.median), *_beside(one, figure)])
    return table


def _worst(one: Summary, figure: Objective) -> list[str]:
    """The worst value, where it is, and failures."""
    failed = ", ".join(f"{n} {outcome}" for outcome, n in one.outcomes.items() if outcome != "finished")
    return [figure.text(one.worst), one.worst_name, failed or "0"]


def _beside(one: Summary, figure: Objective) -> list[str]:
    """What it is beside the baseline."""
    d = one.difference
    if d is None:
        return ["baseline", "", ""]
    if one.equal == one.count and math.isinf(one.median):
        return ["none", "none", f"0 of {one.count}"]
    interval = "too few" if one.is_small else figure.interval(d.low, d.high)
    ratio = "none" if math.isnan(one.ratio) else written_out(one.ratio)
    return [f"{figure.difference(d.median)} ({interval})", ratio, f"{one.better} of {one.count}"]


def _number(column: Number, of: Mapping[str, Mapping[str, float]]) -> str:
    value = of.get(column.metric.name, {}).get(column.element)
    return column.metric.text(value) if value is not None and math.isfinite(value) else "none"


def _facts(comparison: ScenarioComparison) -> dict[str, Any]:
    figure = comparison.figure
    return {
        "problem": comparison.problem,
        "scenarios": comparison.count,
        "seed": comparison.seed,
        "mismatch": comparison.percent,
        "versions": comparison.versions,
        "headline": comparison.figure.name,
        "verdict": comparison.verdict,
        "groups": {name: {one.name: _summary(one, figure) for one in some} for name, some in comparison.groups.items()},
        "controllers": {one.name: _summary(one, figure) for one in comparison.summaries},
        "skipped": comparison.skipped,
        "tuning": comparison.tuning,
    }


def _summary(one: Summary, figure: Objective) -> dict[str, Any]:
    return {
        "median_error": figure.told(one.median),
        "difference": _difference(one, figure),
        "ratio": one.ratio,
        "better": one.better,
        "worst_error": figure.told(one.worst),
        "worst_scenario": one.worst_scenario,
        "worst_name": one.worst_name,
        "rms_error": one.rms_error,
        "metrics": one.metrics,
        "outcomes": one.outcomes,
        "failure_share": one.failure_share,
        "statuses": one.statuses,
        "worst_metrics": one.worst_metrics,
        "rank_error": one.rank_error,
        "shown_scenarios": one.scenarios.tolist(),
        "errors": one.errors.tolist(),
        "values": [figure.told(value) for value in one.values.tolist()],
        "mismatch": one.mismatch.tolist(),
    }


def _difference(one: Summary, figure: Objective) -> dict[str, float] | None:
    if one.difference is None:
        return None
    low, high = figure.told_interval(one.difference.low, one.difference.high)
    return {"median": figure.told(one.difference.median), "low": low, "high": high}
