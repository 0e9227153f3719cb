"""Bands from spreads: the change of a metric that counts as no change.

    half-width = max(3 (max_i v_i - min_i v_i), 1e-6 |v|, floor),        v nominal, v_i under the variants of one source, and v.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fpirhc.baselines.measuring import FINISHED, NOMINAL, Measurement, Number, Variant, metric_of
from fpirhc.simulation import metrics as run_metrics

EXACT, TIGHT, BANDED = "exact", "tight", "banded"
KINDS = (EXACT, TIGHT, BANDED)
FACTOR = 3.0
RELATIVE = 1e-6  # also what 'tight' means
_LOOSE = 0.5  # share of the value above which a band shows few changes
_QUANTA = 1.5  # of a metric that counts cycles: one cycle more or less is no change


@dataclass(frozen=True)
class Metric:
    """One metric of a baseline.

    Args:
        kind: `EXACT`, `TIGHT` or `BANDED`.
        value: a number, a word, or None where the run has none (it never settles).
        band: half-width; 0 for an exact metric.
        spread: distance from the least to the largest value, by source; the band comes from the largest spread.
    """

    kind: str
    value: Number | None
    band: float
    spread: Mapping[str, float]

    @property
    def loose(self) -> bool:
        """Whether the spread is so wide that the band shows few changes."""
        return isinstance(self.value, int | float) and FACTOR * self.widest > _LOOSE * abs(self.value)

    @property
    def widest(self) -> float:
        """The largest spread of any source."""
        return max(self.spread.values(), default=0.0)


@dataclass(frozen=True)
class Expected:
    """Expected results of one controller."""

    outcomes: tuple[str, ...]  # classes of outcomes that are expected; without 'finished' nothing else is compared
    metrics: Mapping[str, Metric]  # metrics by name
    not_compared: Mapping[str, str]  # reasons why metrics are not compared, by name


def expected(
    variants: Sequence[Variant],
    results: Sequence[Measurement],
    period: float,
    metrics: Sequence[run_metrics.Metric] | None = None,
) -> Expected:
    """Return the expectations from the results under every variant.

    Args:
        period: control period, s.
    """
    outcomes = tuple(dict.fromkeys(r.outcome for r in results))
    if outcomes != (FINISHED,):
        return Expected(outcomes, {}, {})
    compared: dict[str, Metric] = {}
    not_compared: dict[str, str] = {}
    names = dict.fromkeys(name for r in results for name in r.numbers)
    for name in names:
        measured = [(v.source, r.numbers[name]) for v, r in zip(variants, results, strict=True) if name in r.numbers]
        if measured[0][0] != NOMINAL:
            not_compared[name] = "only some variants have it"
            continue
        family = metric_of(name, metrics)
        metric = _metric(family, measured, _quantum(family, results[0], period))
        if metric is None:
            not_compared[name] = "some variants have a value and some have none, or words that differ"
        else:
            compared[name] = metric
    return Expected(outcomes, compared, not_compared)


def _metric(family: run_metrics.Metric, measured: Sequence[tuple[str, Number]], quantum: float) -> Metric | None:
    values = [value for _, value in measured]
    if any(isinstance(v, str) for v in values):
        return Metric(EXACT, values[0], 0.0, {}) if len(set(values)) == 1 else None
    numbers = [float(v) for v in values]
    finite = [math.isfinite(v) for v in numbers]
    if not any(finite):
        return Metric(EXACT, None, 0.0, {})
    if not all(finite):
        return None
    value, spread = values[0], _spread([(source, float(v)) for source, v in measured])
    largest = FACTOR * max(spread.values(), default=0.0)
    if family.compared == EXACT and largest == 0:
        return Metric(EXACT, value, 0.0, {})
    rounded = {source: float(f"{width:.2g}") for source, width in spread.items()}
    tight = RELATIVE * abs(float(value))
    if family.compared == TIGHT and largest <= tight:
        return Metric(TIGHT, value, _readable(max(tight, family.floor)), rounded)
    return Metric(BANDED, value, _readable(max(largest, tight, family.floor, _QUANTA * quantum)), rounded)


def _readable(band: float) -> float:
    """The band with three digits, rounded up."""
    return float(f"{1.005 * band:.3g}")


def _spread(measured: Sequence[tuple[str, float]]) -> dict[str, float]:
    by_source: dict[str, list[float]] = {}
    for source, value in measured[1:]:
        by_source.setdefault(source, [measured[0][1]]).append(value)
    widths = {source: max(values) - min(values) for source, values in by_source.items()}
    return {source: width for source, width in widths.items() if width}


def _quantum(family: run_metrics.Metric, nominal: Measurement, period: float) -> float:
    """The smallest step of a metric that counts cycles."""
    cycles = nominal.numbers.get("cycles", 0)
    return family.step(period, int(cycles)) if isinstance(cycles, int | float) and cycles >= 1 else 0.0
