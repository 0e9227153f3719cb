"""The comparison: every metric of a baseline against fresh results, and the judgement of the problem."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

from fpirhc.baselines.baseline import EXACT, Baseline, Expected, Metric, Settings, differences
from fpirhc.baselines.measuring import FINISHED, Measurement, Number, metric_of
from fpirhc.simulation import metrics as run_metrics

HOLDS, BETTER, WORSE, CHANGED, GONE, NEW = "holds", "better", "worse", "changed", "gone", "new"
OUTCOME = "outcome"
NOTABLE = 1e-3  # share of the old value from which a change is called better or worse, and not just a change


@dataclass(frozen=True)
class Row:
    """One comparison."""

    controller: str  # name of the controller
    metric: str  # name of the metric
    old: Number | None  # value of the baseline
    new: Number | None  # fresh value
    band: float | None  # half-width of the band; None where the values must be equal
    verdict: str  # `HOLDS`, `BETTER`, `WORSE`, `CHANGED`, `GONE` or `NEW`

    @property
    def holds(self) -> bool:
        """Whether the fresh value is inside the band."""
        return self.verdict == HOLDS

    @property
    def change(self) -> float | None:
        """(new - old) / |old|, infinite where the old value is zero; None where there are no two numbers."""
        if not _is_number(self.old) or not _is_number(self.new):
            return None
        difference = self.new - self.old
        return difference / abs(self.old) if self.old else math.copysign(math.inf, difference) if difference else 0.0

    @property
    def size(self) -> float:
        """By which rows are sorted: what is no number counts as the largest change, what holds as none."""
        if self.holds:
            return -1.0
        return math.inf if self.change is None else abs(self.change)


def _is_number(value: Number | None) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True)
class Cause:
    """A setting that is not that of the baseline, so that the baseline cannot judge what depends on it."""

    controller: str  # name of the controller that has it; '' for a setting of the problem, on which everything depends
    text: str  # the setting, its old and its new value

    def explains(self, row: Row) -> bool:
        """Whether a change of this row can be a consequence."""
        return not row.holds and self.controller in ("", row.controller)


@dataclass(frozen=True)
class Judgement:
    """The judgement of one problem."""

    problem: str  # name of the problem
    rows: tuple[Row, ...] = ()  # the comparisons
    # reasons why nothing can be concluded from the baseline (missing, damaged, stale); empty for a usable one
    unusable: tuple[str, ...] = ()
    broken: str = ""  # reason why the problem itself could not be loaded; else empty
    reason: str = ""  # reason of the baseline
    date: str = ""  # date of the baseline
    faults: tuple[str, ...] = ()  # why metrics have no number: their functions raised
    notes: tuple[str, ...] = ()  # further sentences
    causes: tuple[Cause, ...] = ()  # settings that are not those of the baseline
    headline: str = ""  # name of the number by which the problem compares its controllers; '': the rms errors

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

    `fresh`: results under the nominal variant, of all controllers or of some.
    """
    whole = set(fresh) == set(settings.controllers)
    names = dict.fromkeys([*fresh, *(baseline.controllers if whole else ())])
    rows: list[Row] = []
    for name in names:
        rows += _rows(name, baseline.controllers.get(name), fresh.get(name), metrics)
    # A function of another name makes the baseline stale where numbers changed: else it has been renamed.
    causes = _stale(baseline, settings, list(fresh), names=not all(row.holds for row in rows))
    return Judgement(
        baseline.problem,
        tuple(rows),
        tuple(f"stale: {cause.text}" for cause in causes),
        reason=baseline.reason,
        date=baseline.date,
        faults=tuple(f"{name}: {why}" for name, one in fresh.items() for why in one.broken.values()),
        notes=tuple(f"{name}: {one.why}" for name, one in fresh.items() if one.why),
        causes=causes,
    )


def ignoring(judgement: Judgement, share: float) -> Judgement:
    """Return the judgement in which changes smaller than a share of the old value hold; counts and words never do.

    `share`: of the old value; 0 ignores nothing.
    """
    small = [r for r in judgement.changed if r.band is not None and r.change is not None and abs(r.change) < share]
    if not small:
        return judgement
    rows = tuple(replace(row, verdict=HOLDS) if row in small else row for row in judgement.rows)
    note = f"{len(small)} changes below {100 * share:g} % are ignored"
    return replace(judgement, rows=rows, notes=(*judgement.notes, note))


def _stale(baseline: Baseline, settings: Settings, controllers: Sequence[str], *, names: bool) -> tuple[Cause, ...]:
    texts = differences("problem", baseline.settings.problem, settings.problem, names=names)
    causes = [Cause("", text) for text in texts]
    for name in controllers:
        before = baseline.settings.controllers.get(name)
        if before is not None:
            texts = differences(f"controller '{name}'", before, settings.controllers[name], names=names)
            causes += [Cause(name, text) for text in texts]
    return tuple(causes)


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
    return Row(controller, name, metric.value, value, band, _verdict(metric_of(name, metrics).better, metric, value))


def _verdict(better: run_metrics.Better, metric: Metric, fresh: Number | None) -> str:
    old = metric.value
    if not isinstance(old, int | float) or not isinstance(fresh, int | float):
        return HOLDS if type(old) is type(fresh) and old == fresh else CHANGED
    if metric.kind == EXACT:
        return HOLDS if fresh == old else CHANGED
    # Written as "inside", so that no comparison with a number that is not finite holds.
    if abs(fresh - old) <= metric.band:
        return HOLDS
    if better == "neither" or abs(fresh - old) < NOTABLE * abs(old):
        return CHANGED
    return BETTER if (fresh < old) == (better == "smaller") else WORSE
