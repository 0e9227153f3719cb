"""The comparison: every metric of a baseline against fresh results, and the judgement of the problem."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fpirhc.baselines.bands import Expected, Metric
from fpirhc.baselines.baseline import Baseline
from fpirhc.baselines.catalogue import EXACT, family_of
from fpirhc.baselines.measuring import FINISHED, Measurement, Number
from fpirhc.baselines.settings import Settings, differences
from fpirhc.simulation import metrics as run_metrics

HOLDS, BETTER, WORSE, CHANGED, GONE, NEW = "holds", "better", "worse", "changed", "gone", "new"
OUTCOME = "outcome"


@dataclass(frozen=True)
class Row:
    """One comparison.

    Args:
        controller: name of the controller.
        metric: name of the metric.
        old: value of the baseline.
        new: fresh value.
        band: half-width of the band; None where the values must be equal.
        verdict: `HOLDS`, `BETTER`, `WORSE`, `CHANGED`, `GONE` or `NEW`.
    """

    controller: str
    metric: str
    old: Number | None
    new: Number | None
    band: float | None
    verdict: str

    @property
    def holds(self) -> bool:
        """Whether the fresh value is inside the band."""
        return self.verdict == HOLDS


@dataclass(frozen=True)
class Judgement:
    """The judgement of one problem.

    Args:
        problem: name of the problem.
        rows: the comparisons.
        unusable: reasons why nothing can be concluded from the baseline (missing, damaged, stale); empty for a usable one.
        broken: reason why the problem itself could not be loaded; else empty.
        reason: reason of the baseline.
        date: date of the baseline.
        notes: further sentences.
    """

    problem: str
    rows: tuple[Row, ...] = ()
    unusable: tuple[str, ...] = ()
    broken: str = ""
    reason: str = ""
    date: str = ""
    notes: tuple[str, ...] = ()

    @property
    def changed(self) -> tuple[Row, ...]:
        """The rows that do not hold."""
        return tuple(row for row in self.rows if not row.holds)

    @property
    def holds(self) -> bool:
        """Whether there is a comparison and all comparisons hold."""
        return bool(self.rows) and not (self.changed or self.unusable or self.broken)


def judge(
    baseline: Baseline,
    settings: Settings,
    fresh: Mapping[str, Measurement],
    metrics: Sequence[run_metrics.Metric] | None = None,
) -> Judgement:
    """Compare the fresh results of a problem with its baseline.

    Args:
        baseline: the baseline.
        settings: settings of the problem as it is now.
        fresh: results under the nominal variant, of all controllers or of some.
        metrics: metrics of the problem's runs; None: the shipped and the installed ones.
    """
    whole = set(fresh) == set(settings.controllers)
    names = dict.fromkeys([*fresh, *(baseline.controllers if whole else ())])
    rows: list[Row] = []
    for name in names:
        rows += _rows(name, baseline.controllers.get(name), fresh.get(name), metrics)
    notes = [f"{name}: {one.why}" for name, one in fresh.items() if one.why] + _old_names(baseline)
    return Judgement(
        baseline.problem,
        tuple(rows),
        _stale(baseline, settings, list(fresh)),
        reason=baseline.reason,
        date=baseline.date,
        notes=tuple(notes),
    )


def _old_names(baseline: Baseline) -> list[str]:
    if not baseline.renamed:
        return []
    names = ", ".join(f"'{old}' is now '{new}'" for old, new in sorted(baseline.renamed.items()))
    return [f"the baseline has names of an older version and is read with those of today: {names}"]


def _stale(baseline: Baseline, settings: Settings, names: Sequence[str]) -> tuple[str, ...]:
    sentences = differences("problem", baseline.settings.problem, settings.problem)
    for name in names:
        before = baseline.settings.controllers.get(name)
        if before is not None:
            sentences += differences(f"controller '{name}'", before, settings.controllers[name])
    return tuple(f"stale: {text}" for text in sentences)


def _rows(
    name: str, expected: Expected | None, fresh: Measurement | None, metrics: Sequence[run_metrics.Metric] | None
) -> list[Row]:
    if expected is None or fresh is None:
        old, new = (None, fresh.outcome) if fresh else (" or ".join(expected.outcomes) if expected else None, None)
        return [Row(name, OUTCOME, old, new, None, NEW if fresh else GONE)]
    wanted = " or ".join(expected.outcomes)
    if fresh.outcome not in expected.outcomes:
        return [Row(name, OUTCOME, wanted, fresh.outcome, None, CHANGED)]
    rows = [Row(name, OUTCOME, wanted, fresh.outcome, None, HOLDS)]
    if expected.outcomes != (FINISHED,):
        return rows
    for metric in dict.fromkeys([*expected.metrics, *fresh.numbers]):
        if metric in expected.metrics or metric not in expected.not_compared:
            rows.append(_row(name, metric, expected.metrics.get(metric), fresh.numbers.get(metric), metrics))
    return rows


def _row(
    controller: str,
    name: str,
    metric: Metric | None,
    fresh: Number | None,
    metrics: Sequence[run_metrics.Metric] | None,
) -> Row:
    if metric is None:
        return Row(controller, name, None, fresh, None, NEW)
    band = None if metric.kind == EXACT else metric.band
    if fresh is None:
        return Row(controller, name, metric.value, None, band, GONE)
    value = fresh if isinstance(fresh, str) or math.isfinite(fresh) else None
    return Row(controller, name, metric.value, value, band, _verdict(family_of(name, metrics).better, metric, value))


def _verdict(better: run_metrics.Better, metric: Metric, fresh: Number | None) -> str:
    old = metric.value
    if not isinstance(old, int | float) or not isinstance(fresh, int | float):
        return HOLDS if type(old) is type(fresh) and old == fresh else CHANGED
    if metric.kind == EXACT:
        return HOLDS if fresh == old else CHANGED
    # Written as "inside", so that no comparison with a number that is not finite holds.
    if abs(fresh - old) <= metric.band:
        return HOLDS
    if better == "neither":
        return CHANGED
    return BETTER if (fresh < old) == (better == "smaller") else WORSE
