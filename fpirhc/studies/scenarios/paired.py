"""Statistics of each controller over many paired scenarios: medians, paired differences, worst cases, failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fpirhc.by_name import FoundByName
from fpirhc.simulation.metrics import Metric, known_metrics
from fpirhc.studies.comparison.outcome import Outcome
from fpirhc.summary import in_percent

Record = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Summary(FoundByName):
    """One controller over all scenarios; errors are relative (see `score`), infinite for runs that ended early.

    Args:
        name: name of the controller.
        errors: relative errors by scenario, shape (n,).
        mismatch: mismatch of the model by scenario, shape (n,).
        median: median of the errors.
        worst: largest error.
        worst_scenario: number of the scenario with the largest error.
        worst_name: its name; the number as text where scenarios are random.
        metrics: median over the scenarios, by metric and element; a run without the number counts as worse than any
            other.
        outcomes: number of scenarios by outcome.
        statuses: number of cycles by status, over all scenarios.
        difference: this error minus the baseline's in the same scenario; None for the baseline itself.
        ratio: median of this error over the baseline's.
        better: number of scenarios in which this error is the smaller one.
    """

    name: str
    errors: np.ndarray
    mismatch: np.ndarray
    median: float
    worst: float
    worst_scenario: int
    worst_name: str
    metrics: Mapping[str, Mapping[str, float]]
    outcomes: Mapping[str, int]
    statuses: Mapping[str, int]
    difference: ConfidenceInterval | None
    ratio: float
    better: int

    @property
    def rms_error(self) -> Mapping[str, float]:
        """Median rms error by coordinate."""
        return self.metrics["rms_error"]

    @property
    def outcome(self) -> Outcome | None:
        """What it is beside the baseline, where the interval of the difference leaves no doubt; None for the baseline itself."""
        if self.difference is None:
            return None
        low, high = self.difference.low, self.difference.high
        return Outcome.BETTER if high < 0 else Outcome.WORSE if low > 0 else Outcome.NO_DIFFERENCE

    @property
    def failures(self) -> int:
        """Scenarios that ended early or diverged."""
        return sum(n for outcome, n in self.outcomes.items() if outcome != "finished")


def summarise(
    name: str,
    records: Sequence[Record],
    baseline: Sequence[Record] | None,
    seed: int,
    metrics: Sequence[Metric] | None = None,
) -> Summary:
    """Return the summary of one controller's records against the baseline's of the same scenarios, in the same order.

    Args:
        name: name of the controller.
        records: its records.
        baseline: the baseline's records; None for the baseline itself.
        seed: of the resampling.
        metrics: metrics with which the records were measured; None: the shipped and the installed ones.
    """
    errors = errors_of(records)
    before = errors if baseline is None else errors_of(baseline)
    worst = int(np.argmax(errors))
    return Summary(
        name=name,
        errors=errors,
        mismatch=np.array([r["mismatch"] for r in records]),
        median=float(middle(errors)),
        worst=float(errors[worst]),
        worst_scenario=int(records[worst]["scenario"]),
        worst_name=str(records[worst].get("name", records[worst]["scenario"])),
        metrics=_medians(records, known_metrics() if metrics is None else metrics),
        outcomes=dict(Counter(str(r["outcome"]) for r in records)),
        statuses=dict(sum((Counter(r["metrics"]["status"]) for r in records), Counter())),
        difference=None if baseline is None else median_interval(_differences(errors, before), seed),
        ratio=float(middle(_ratios(errors, before))),
        better=int(np.sum(errors < before)),
    )


def _medians(records: Sequence[Record], metrics: Sequence[Metric]) -> dict[str, dict[str, float]]:
    """Median of every number that some scenario has."""
    medians: dict[str, dict[str, float]] = {}
    for metric in metrics:
        by_element = [r["metrics"].get(metric.name, {}) for r in records]
        missing = -np.inf if metric.better == "larger" else np.inf
        for element in dict.fromkeys(e for numbers in by_element for e in numbers):
            values = _numbers([numbers.get(element) for numbers in by_element], missing)
            medians.setdefault(metric.name, {})[element] = float(middle(values))
    return medians


def errors_of(records: Sequence[Record]) -> np.ndarray:
    """Relative errors, infinite where a run ended early."""
    return _numbers([r["error"] for r in records])


def _numbers(values: Sequence[float | None], missing: float = np.inf) -> np.ndarray:
    return np.array([missing if v is None else v for v in values], dtype=float)


def _differences(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Differences of errors; where both runs failed, the difference is zero."""
    with np.errstate(invalid="ignore"):
        differences = after - before
    return np.where(np.isnan(differences), 0.0, differences)


def _ratios(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = after / before
    return np.where(np.isnan(ratios), 1.0, ratios)


def noun(named: bool) -> str:
    """Return what scenarios are called where they are named, and where they are not."""
    return "cases" if named else "scenarios"


def verdict(summaries: Sequence[Summary], skipped: Mapping[str, str], what: str = "scenarios") -> tuple[str, ...]:
    """Return sentences: every controller against the baseline, failures, and controllers that were not run.

    Args:
        summaries: the baseline first.
        skipped: reasons why controllers were not run, by name.
        what: what the scenarios are called.
    """
    sentences = [_sentence(summaries[0], s, what) for s in summaries[1:]]
    if len(summaries) == 1:
        only = summaries[0]
        sentences.append(
            f"{only.name} has a median error of {percent(only.median)}; there is nothing to compare it with."
        )
    elif not summaries:
        sentences.append("No controller could serve the problem, so nothing can be compared.")
    sentences += [_failed(s, what) for s in summaries if s.failures]
    if skipped:
        sentences.append("Not run: " + "; ".join(f"{name} ({why})" for name, why in skipped.items()) + ".")
    return tuple(sentences)


def _sentence(baseline: Summary, one: Summary, what: str) -> str:
    difference = one.difference
    assert difference is not None
    count = one.errors.size
    numbers = (
        f"median difference of the error {signed(difference.median)}, "
        f"95 % interval {signed(difference.low)} to {signed(difference.high)}; smaller in {one.better} of {count} {what}"
    )
    if one.outcome is Outcome.BETTER:
        return f"{one.name} has a smaller error than {baseline.name} ({numbers}; {one.ratio:.3g} times its error)."
    if one.outcome is Outcome.WORSE:
        return f"{one.name} has a larger error than {baseline.name} ({numbers}; {one.ratio:.3g} times its error)."
    return f"{one.name} and {baseline.name} show no clear difference ({numbers})."


def _failed(one: Summary, what: str) -> str:
    parts = [f"{n} {outcome}" for outcome, n in one.outcomes.items() if outcome != "finished"]
    return f"{one.name} fails in {one.failures} of {one.errors.size} {what} ({', '.join(parts)})."


def percent(share: float) -> str:
    """Return a share as text."""
    return in_percent(share) if np.isfinite(share) else "none (failed)"


def signed(share: float) -> str:
    """Return a difference of shares as text."""
    return (
        f"{100 * share:+.3g} %"
        if np.isfinite(share)
        else ("worse by a failure" if share > 0 else "better by a failure")
    )


RESAMPLES = 4000
LEVEL = 0.95
_AT_ONCE = 2_000_000  # largest number of values that are drawn at once


@dataclass(frozen=True)
class ConfidenceInterval:
    """A median and its interval at level `LEVEL`.

    Args:
        median: the median.
        low: lower end of the interval.
        high: upper end of the interval.
    """

    median: float
    low: float
    high: float


def median_interval(values: np.ndarray, seed: int) -> ConfidenceInterval:
    """Return the median of `values`, shape (n,), and its percentile bootstrap interval.

    Infinite values are allowed: they lie beyond all others. The interval is that of the population's median; with fewer than
    about ten values it is too narrow.

    References:
        B. Efron, R. J. Tibshirani, An Introduction to the Bootstrap, Chapman and Hall, 1993, chapter 13.
    """
    random = np.random.default_rng(np.random.SeedSequence(seed))
    rows = max(1, _AT_ONCE // values.size)
    samples: list[np.ndarray] = []
    for at in range(0, RESAMPLES, rows):
        size = (min(rows, RESAMPLES - at), values.size)
        samples.append(middle(values[random.integers(values.size, size=size)]))
    medians = np.sort(np.concatenate(samples))
    tail = round((1 - LEVEL) / 2 * RESAMPLES)
    return ConfidenceInterval(float(middle(values)), float(medians[tail]), float(medians[-1 - tail]))


def middle(values: np.ndarray) -> np.ndarray:
    """Median along the last axis; between minus and plus infinity lies zero."""
    size = values.shape[-1]
    places = [(size - 1) // 2, size // 2]
    low, high = np.moveaxis(np.partition(values, places, axis=-1)[..., places], -1, 0)
    with np.errstate(invalid="ignore"):
        between = 0.5 * low + 0.5 * high
    return np.where(low == high, low, np.where(np.isnan(between), 0.0, between))
