"""Statistics of each controller over many paired scenarios: medians, paired differences, worst cases, failures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fpirhc.by_name import FoundByName
from fpirhc.simulation.metrics import Metric, known_metrics
from fpirhc.studies.comparison.changes import Outcome
from fpirhc.studies.tuning.objective import Objective
from fpirhc.summary import in_percent

Record = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Summary(FoundByName):
    """One controller over all scenarios. Values are relative errors, or those of another figure with the sign that makes smaller
    better; they are infinite for runs that ended early.
    """

    name: str  # name of the controller
    errors: np.ndarray  # relative errors by scenario, shape (n,)
    values: np.ndarray  # of the figure of the comparison by scenario, shape (n,)
    mismatch: np.ndarray  # mismatch of the model by scenario, shape (n,)
    median: float  # median of the values
    worst: float  # worst value
    worst_scenario: int  # number of the scenario with the worst value
    worst_name: str  # its name; the number as text where scenarios are random
    # median over the scenarios, by metric and element; a run without the number counts as worse than any other
    metrics: Mapping[str, Mapping[str, float]]
    # the worst number over the scenarios, by metric and element, of metrics with a better direction
    worst_metrics: Mapping[str, Mapping[str, float]]
    outcomes: Mapping[str, int]  # number of scenarios by outcome
    statuses: Mapping[str, int]  # number of cycles by status, over all scenarios
    # this value minus the baseline's in the same scenario; None for the baseline itself
    difference: ConfidenceInterval | None
    ratio: float  # median of this value over the baseline's
    better: int  # number of scenarios in which this value is the smaller one
    equal: int  # number of scenarios in which both are equal, or failed; 0 for the baseline itself

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

    @property
    def failure_share(self) -> tuple[float, float]:
        """The exact interval of the share of failures, see `share_interval`."""
        return share_interval(self.failures, self.errors.size)


def summarise(
    name: str,
    records: Sequence[Record],
    baseline: Sequence[Record] | None,
    seed: int,
    metrics: Sequence[Metric] | None = None,
    figure: Objective | None = None,
) -> Summary:
    """Return the summary of one controller's records against the baseline's of the same scenarios, in the same order.

    Args:
        baseline: the baseline's records; None for the baseline itself.
        figure: by which controllers are compared; None: the relative error.
    """
    figure, known = figure or Objective(), known_metrics() if metrics is None else metrics
    values = np.array([figure.value(r) for r in records])
    before = values if baseline is None else np.array([figure.value(r) for r in baseline])
    worst = int(np.argmax(values))
    return Summary(
        name=name,
        errors=np.array([Objective().value(r) for r in records]),
        values=values,
        mismatch=np.array([r["mismatch"] for r in records]),
        median=float(middle(values)),
        worst=float(values[worst]),
        worst_scenario=int(records[worst]["scenario"]),
        worst_name=str(records[worst].get("name", records[worst]["scenario"])),
        metrics=_over(records, known, lambda values, _: float(middle(values))),
        worst_metrics=_over(
            records,
            [metric for metric in known if metric.better != "neither"],
            lambda values, larger: float(values.min() if larger else values.max()),
        ),
        outcomes=dict(Counter(str(r["outcome"]) for r in records)),
        statuses=dict(sum((Counter(r["metrics"]["status"]) for r in records), Counter())),
        difference=None if baseline is None else median_interval(_differences(values, before), seed),
        ratio=float(middle(_ratios(values, before))),
        better=int(np.sum(values < before)),
        equal=0 if baseline is None else int(np.sum(values == before)),
    )


def _over(
    records: Sequence[Record], metrics: Sequence[Metric], one_of: Callable[[np.ndarray, bool], float]
) -> dict[str, dict[str, float]]:
    """One of all scenarios' numbers, for every number that some scenario has; `one_of` is given whether larger ones are better."""
    larger = {m.name: m.better == "larger" for m in metrics}
    columns: dict[str, dict[str, np.ndarray]] = {name: {} for name in larger}
    for k, record in enumerate(records):  # once, because a record is made of columns anew
        for name, numbers in record["metrics"].items():
            for element, value in numbers.items() if name in columns else ():
                if element not in columns[name]:
                    columns[name][element] = np.full(len(records), -np.inf if larger[name] else np.inf)
                if value is not None:
                    columns[name][element][k] = value
    return {name: {e: one_of(v, larger[name]) for e, v in one.items()} for name, one in columns.items() if one}


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


def verdict(
    summaries: Sequence[Summary], skipped: Mapping[str, str], what: str = "scenarios", figure: Objective | None = None
) -> tuple[str, ...]:
    """Return sentences: every controller against the baseline, failures, and controllers that were not run.

    Args:
        figure: by which controllers are compared; None: the relative error.
    """
    figure = figure or Objective()
    sentences = [_sentence(summaries[0], s, what, figure) for s in summaries[1:]]
    if len(summaries) == 1:
        only = summaries[0]
        sentences.append(
            f"{only.name} has a median {figure.noun} of {figure.text(only.median)}; there is nothing to compare it with."
        )
    elif not summaries:
        sentences.append("No controller could serve the problem, so nothing can be compared.")
    if summaries:
        worst = (f"{s.name} {figure.text(s.worst)} in {s.worst_name}" for s in summaries)
        sentences.append(f"Worst {what}: {'; '.join(worst)}.")
    sentences += [_failed(s, what) for s in summaries if s.failures]
    sentences += _nowhere([s for s in summaries if not s.failures], what)
    if skipped:
        sentences.append("Not run: " + "; ".join(f"{name} ({why})" for name, why in skipped.items()) + ".")
    return tuple(sentences)


def _sentence(baseline: Summary, one: Summary, what: str, figure: Objective) -> str:
    difference = one.difference
    assert difference is not None
    count = one.errors.size
    numbers = (
        f"median difference of {figure.subject} {figure.difference(difference.median)}, 95 % interval "
        f"{figure.interval(difference.low, difference.high)}; "
        f"{figure.better} in {one.better} of {count} {what}{f', equal in {one.equal}' if one.equal else ''}"
    )
    times = f"{one.ratio:.3g} times its {figure.noun}"
    worse = "larger" if figure.better == "smaller" else "smaller"
    if one.outcome is Outcome.BETTER:
        return f"{one.name} has a {figure.better} {figure.noun} than {baseline.name} ({numbers}; {times})."
    if one.outcome is Outcome.WORSE:
        return f"{one.name} has a {worse} {figure.noun} than {baseline.name} ({numbers}; {times})."
    return f"{one.name} and {baseline.name} show no clear difference ({numbers})."


def _failed(one: Summary, what: str) -> str:
    parts = [f"{n} {outcome}" for outcome, n in one.outcomes.items() if outcome != "finished"]
    said = f"{one.name} fails in {one.failures} of {one.errors.size} {what} ({', '.join(parts)})"
    if what == noun(True):
        return f"{said}."
    low, high = map(in_percent, one.failure_share)
    return f"{said}: {low} to {high} of what is drawn so, with 95 % confidence."


def _nowhere(none: Sequence[Summary], what: str) -> list[str]:
    """What it shows that nobody failed; named cases are no sample of anything."""
    if not none or what == noun(True):
        return []
    names = " and ".join(filter(None, (", ".join(s.name for s in none[:-1]), none[-1].name)))
    verb = "fail" if len(none) > 1 else "fails"
    most = in_percent(none[0].failure_share[1])
    return [
        f"{names} {verb} in none of {none[0].errors.size} {what}: in at most {most} of what is drawn so, with 95 % confidence."
    ]


RESAMPLES = 4000
LEVEL = 0.95
_MANY = 2000  # values from which no resample is drawn
_AT_ONCE = 2_000_000  # largest number of values that are drawn at once


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return the exact interval of the share of an event that was seen `count` times in `total` independent trials.

        P(X >= count | low) = P(X <= count | high) = (1 - LEVEL) / 2,        X binomial,

    and the whole of the level at the other end where it was never seen, or always: never in n trials is at most 1 - 0.05^(1/n).

    References:
        C. J. Clopper, E. S. Pearson, The use of confidence or fiducial limits illustrated in the case of the binomial, Biometrika
        26(4), 1934.
    """
    from scipy.special import betaincinv  # it takes longer to import than a verdict to write

    tail = (1 - LEVEL) / (1 if count in (0, total) else 2)
    low = float(betaincinv(count, total - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, total - count, 1 - tail)) if count < total else 1.0
    return low, high


@dataclass(frozen=True)
class ConfidenceInterval:
    """A median and its interval at level `LEVEL`."""

    median: float  # the median
    low: float  # lower end of the interval
    high: float  # upper end of the interval


def median_interval(values: np.ndarray, seed: int) -> ConfidenceInterval:
    """Return the median of `values`, shape (n,), and its percentile bootstrap interval.

    Infinite values are allowed: they lie beyond all others. The interval is that of the population's median; with fewer than
    about ten values it is too narrow. Of many values the ends are those of infinitely many resamples: the median of one is at most
    the k-th value with the probability P(X >= n / 2), X binomial with n trials of k / n.

    References:
        B. Efron, R. J. Tibshirani, An Introduction to the Bootstrap, Chapman and Hall, 1993, chapter 13.
    """
    if values.size > _MANY:
        low, high = np.sort(values)[[*_ends_of_all_resamples(values.size)]]
        return ConfidenceInterval(float(middle(values)), float(low), float(high))
    random = np.random.default_rng(np.random.SeedSequence(seed))
    rows = max(1, _AT_ONCE // values.size)
    samples: list[np.ndarray] = []
    for at in range(0, RESAMPLES, rows):
        size = (min(rows, RESAMPLES - at), values.size)
        samples.append(middle(values[random.integers(values.size, size=size)]))
    medians = np.sort(np.concatenate(samples))
    tail = round((1 - LEVEL) / 2 * RESAMPLES)
    return ConfidenceInterval(float(middle(values)), float(medians[tail]), float(medians[-1 - tail]))


def _ends_of_all_resamples(size: int) -> tuple[int, int]:
    """Places, from 0, of the sorted values between which the median of a resample lies with probability `LEVEL`."""
    from scipy.special import bdtrc

    shares = np.arange(1, size) / size
    at_most = np.asarray(bdtrc(math.ceil(size / 2) - 1, size, shares))
    low, high = np.searchsorted(at_most, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return int(low), int(high)


def middle(values: np.ndarray) -> np.ndarray:
    """Median along the last axis; between minus and plus infinity lies zero."""
    size = values.shape[-1]
    places = [(size - 1) // 2, size // 2]
    low, high = np.moveaxis(np.partition(values, places, axis=-1)[..., places], -1, 0)
    with np.errstate(invalid="ignore"):
        between = 0.5 * low + 0.5 * high
    return np.where(low == high, low, np.where(np.isnan(between), 0.0, between))
