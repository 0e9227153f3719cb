"""The comparison: every metric of a baseline against fresh results, and what follows for the problem."""

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
    """One comparison; `band` is the half-width, None where equality is asked for."""

    controller: str
    metric: str
    old: Number | None
    new: Number | None
    band: float | None
    verdict: str

    @property
    def holds(self) -> bool:
        """Whether the metric is as the baseline says."""
        return self.verdict == HOLDS


@dataclass(frozen=True)
class Judgement:
    """What became of one problem.

    unusable: why nothing can be concluded from the baseline (missing, damaged, stale); empty when it can. broken: why the problem
    itself could not be loaded. reason, date: of the baseline.
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
        """Whether there was something to compare and all of it holds."""
        return bool(self.rows) and not (self.changed or self.unusable or self.broken)


def judge(
    baseline: Baseline,
    settings: Settings,
    fresh: Mapping[str, Measurement],
    metrics: Sequence[run_metrics.Metric] | None = None,
) -> Judgement:
    """Compare the fresh results of a problem with its baseline.

    Parameters: `settings` of the problem as it is now; `fresh` results under the nominal variant by controller: all of the
    problem's, or those asked for; `metrics` that the problem's runs are measured by.
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
    said = differences("problem", baseline.settings.problem, settings.problem)
    for name in names:
        before = baseline.settings.controllers.get(name)
        if before is not None:
            said += differences(f"controller '{name}'", before, settings.controllers[name])
    return tuple(f"stale: {text}" for text in said)


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
    found: Number | None,
    metrics: Sequence[run_metrics.Metric] | None,
) -> Row:
    if metric is None:
        return Row(controller, name, None, found, None, NEW)
    band = None if metric.kind == EXACT else metric.band
    if found is None:
        return Row(controller, name, metric.value, None, band, GONE)
    value = found if isinstance(found, str) or math.isfinite(found) else None
    return Row(controller, name, metric.value, value, band, _verdict(family_of(name, metrics).better, metric, value))


def _verdict(better: run_metrics.Better, metric: Metric, found: Number | None) -> str:
    old = metric.value
    if not isinstance(old, int | float) or not isinstance(found, int | float):
        return HOLDS if type(old) is type(found) and old == found else CHANGED
    if metric.kind == EXACT:
        return HOLDS if found == old else CHANGED
    # Asked as "inside", so that no comparison with a number that is not finite can hold.
    if abs(found - old) <= metric.band:
        return HOLDS
    if better == "neither":
        return CHANGED
    return BETTER if (found < old) == (better == "smaller") else WORSE
