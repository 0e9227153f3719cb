"""Bands from spreads: how far a metric may move before it has changed.

    half-width = max(3 (max_i v_i - min_i v_i), 1e-6 |v|, floor),        v nominal, v_i under the variants of one source, and v.

Three: of a normal value and eight seeds, another draw leaves the band about once in 10 000 times (with five seeds 30 times as
often). A count that is the same under all variants is exact.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fpirhc.baselines.catalogue import BANDED, EXACT, TIGHT, Family, family_of
from fpirhc.baselines.measuring import FINISHED, Measurement, Number
from fpirhc.baselines.variants import NOMINAL, Variant
from fpirhc.simulation import metrics as run_metrics

FACTOR = 3.0
RELATIVE = 1e-6  # also what 'tight' means
_LOOSE = 0.5  # share of the value beyond which a band hardly holds anything
_QUANTA = 1.5  # of a metric that counts cycles: one cycle more or less is no change


@dataclass(frozen=True)
class Metric:
    """One metric of a baseline.

    kind: exact, tight or banded. value: a number, a word, or None where the run has none (it never settles). band: half-width,
    0 for an exact one. spread: from the least to the largest value by source; what the band was made of.
    """

    kind: str
    value: Number | None
    band: float
    spread: Mapping[str, float]

    @property
    def loose(self) -> bool:
        """Whether the spread is so wide that the band hardly holds anything."""
        return isinstance(self.value, int | float) and FACTOR * self.widest > _LOOSE * abs(self.value)

    @property
    def widest(self) -> float:
        """The largest spread of any source."""
        return max(self.spread.values(), default=0.0)


@dataclass(frozen=True)
class Expected:
    """What a baseline expects of one controller.

    outcomes: classes that the run may end in; without 'finished' nothing else is compared. metrics: by name. not_compared:
    metrics that cannot be, with the reason.
    """

    outcomes: tuple[str, ...]
    metrics: Mapping[str, Metric]
    not_compared: Mapping[str, str]


def expected(
    variants: Sequence[Variant],
    results: Sequence[Measurement],
    period: float,
    metrics: Sequence[run_metrics.Metric] | None = None,
) -> Expected:
    """Return what to expect from the results under every variant, the nominal one first; `metrics` are the problem's."""
    outcomes = tuple(dict.fromkeys(r.outcome for r in results))
    if outcomes != (FINISHED,):
        return Expected(outcomes, {}, {})
    compared: dict[str, Metric] = {}
    not_compared: dict[str, str] = {}
    names = dict.fromkeys(name for r in results for name in r.numbers)
    for name in names:
        found = [(v.source, r.numbers[name]) for v, r in zip(variants, results, strict=True) if name in r.numbers]
        if found[0][0] != NOMINAL:
            not_compared[name] = "only some variants have it"
            continue
        family = family_of(name, metrics)
        metric = _metric(family, found, _quantum(family, results[0], period))
        if metric is None:
            not_compared[name] = "some variants have a value and some have none, or words that differ"
        else:
            compared[name] = metric
    return Expected(outcomes, compared, not_compared)


def _metric(family: Family, found: Sequence[tuple[str, Number]], quantum: float) -> Metric | None:
    values = [value for _, value in found]
    if any(isinstance(v, str) for v in values):
        return Metric(EXACT, values[0], 0.0, {}) if len(set(values)) == 1 else None
    numbers = [float(v) for v in values]
    finite = [math.isfinite(v) for v in numbers]
    if not any(finite):
        return Metric(EXACT, None, 0.0, {})
    if not all(finite):
        return None
    value, spread = values[0], _spread([(source, float(v)) for source, v in found])
    largest = FACTOR * max(spread.values(), default=0.0)
    if family.kind == EXACT and largest == 0:
        return Metric(EXACT, value, 0.0, {})
    told = {source: float(f"{width:.2g}") for source, width in spread.items()}
    tight = RELATIVE * abs(float(value))
    if family.kind == TIGHT and largest <= tight:
        return Metric(TIGHT, value, _readable(max(tight, family.floor)), told)
    return Metric(BANDED, value, _readable(max(largest, tight, family.floor, _QUANTA * quantum)), told)


def _readable(band: float) -> float:
    """The band with three digits, rounded up."""
    return float(f"{1.005 * band:.3g}")


def _spread(found: Sequence[tuple[str, float]]) -> dict[str, float]:
    by_source: dict[str, list[float]] = {}
    for source, value in found[1:]:
        by_source.setdefault(source, [found[0][1]]).append(value)
    widths = {source: max(values) - min(values) for source, values in by_source.items()}
    return {source: width for source, width in widths.items() if width}


def _quantum(family: Family, nominal: Measurement, period: float) -> float:
    """The smallest step of a metric that counts cycles."""
    cycles = nominal.numbers.get("cycles", 0)
    if family.step is None or not isinstance(cycles, int | float) or cycles < 1:
        return 0.0
    return family.step(period, int(cycles))
