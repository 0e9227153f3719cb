"""What is said of each controller over many paired scenarios: medians, paired differences, worst cases, failures."""

from __future__ import annotations

import itertools
import math
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fpirhc.fields.checked import FoundByName
from fpirhc.simulation.metrics import Metric, known_metrics
from fpirhc.studies.comparison.changes import Outcome
from fpirhc.studies.objective import Objective
from fpirhc.summary import in_percent


class Quantiles:
    """Numbers, any of which is told by its place in the order of size.

    The first `room` numbers are kept as they are. A full buffer is sorted and every second number of it goes on to the next
    buffer, where it counts twice as much: in turns those at even and at odd places, so that two of these steps together move no
    number by more than the weight that it had. There are as many buffers as the count has powers of two above `room`.

    Args:
        numbers: the first ones; infinite ones are allowed, NaN is not.
        room: numbers of a buffer, an even number.

    Attributes:
        count: numbers in all.

    References:
        J. I. Munro, M. S. Paterson, Selection and sorting with limited storage, Theoretical Computer Science 12, 1980.
        G. S. Manku, S. Rajagopalan, B. G. Lindsay, Approximate medians and other quantiles in one pass and with limited memory,
        Proc. ACM SIGMOD, 1998.
    """

    def __init__(self, numbers: Iterable[float] = (), room: int = 8192) -> None:
        self._room, self.count = room, 0
        self._buffers, self._steps = [array("d")], [0]
        self._last = self._buffers[0]
        for number in numbers:
            self.add(number)

    def add(self, number: float) -> None:
        """Add one number."""
        if len(self._last) >= self._room:
            self._pass_on(0)
            self._last = self._buffers[0]
        self._last.append(number)
        self.count += 1

    @property
    def error(self) -> int:
        """By how many places at most a number that is told is away from where it was asked: guaranteed, and 0 up to `room`."""
        return sum(2**level * ((steps + 1) // 2) for level, steps in enumerate(self._steps))

    @property
    def numbers(self) -> np.ndarray:
        """All numbers in the order in which they came; of more than `room`, those since the last full buffer."""
        return np.array(self._last)

    def at(self, place: int) -> float:
        """Return the number at a place, from 0, or at the nearest place that there is."""
        sizes = [len(one) for one in self._buffers]
        numbers, weights = np.concatenate(self._buffers), np.repeat(2 ** np.arange(len(sizes)), sizes)
        order = np.argsort(numbers, kind="stable")
        place = min(max(place, 0), self.count - 1)
        return float(numbers[order[np.searchsorted(np.cumsum(weights[order]), place, side="right")]])

    @property
    def median(self) -> float:
        """The number in the middle; between two numbers it is half their sum, and between minus and plus infinity zero."""
        low, high = self.at((self.count - 1) // 2), self.at(self.count // 2)
        between = 0.5 * low + 0.5 * high
        return low if low == high else 0.0 if math.isnan(between) else between

    def _pass_on(self, level: int) -> None:
        if level + 1 == len(self._buffers):
            self._buffers.append(array("d"))
            self._steps.append(0)
        if len(self._buffers[level + 1]) >= self._room:
            self._pass_on(level + 1)
        self._buffers[level + 1].extend(sorted(self._buffers[level])[self._steps[level] % 2 :: 2])
        self._buffers[level] = array("d")
        self._steps[level] += 1


Record = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Summary(FoundByName):
    """One controller over all scenarios. Values are relative errors, or those of another figure with the sign that makes smaller
    better; they are infinite for runs that ended early.
    """

    name: str  # name of the controller
    count: int  # number of scenarios
    # numbers of those scenarios that are kept: all, or of thousands every second, fourth and so on, shape (k,)
    scenarios: np.ndarray
    errors: np.ndarray  # their relative errors, shape (k,)
    values: np.ndarray  # their figures of the comparison, shape (k,)
    mismatch: np.ndarray  # their mismatches of the model, shape (k,)
    # by which share of the scenarios a median may be away from the middle, see `Quantiles`
    rank_error: float
    median: float  # median of the values
    median_scenario: int  # number of a scenario with the median, or with the nearest value that is kept
    worst: float  # worst value
    worst_scenario: int  # number of the scenario with the worst value
    worst_name: str  # its name; the number as text where scenarios are random
    first_ended: int | None  # number of the first scenario that ended early
    # median over the scenarios, by metric and element; a run without the number counts as worse than any other
    metrics: Mapping[str, Mapping[str, float]]
    # the worst number over the scenarios, by metric and element, of metrics with a better direction
    worst_metrics: Mapping[str, Mapping[str, float]]
    outcomes: Mapping[str, int]  # number of scenarios by outcome
    statuses: Mapping[str, int]  # number of cycles by status, over all scenarios
    # this value minus the baseline's in the same scenario; None for the baseline itself
    difference: ConfidenceInterval | None
    ratio: float  # median of this value over the baseline's; NaN where a value is negative
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
        if self.is_small:
            return Outcome.NO_DIFFERENCE
        low, high = self.difference.low, self.difference.high
        return Outcome.BETTER if high < 0 else Outcome.WORSE if low > 0 else Outcome.NO_DIFFERENCE

    @property
    def is_small(self) -> bool:
        """Whether there are too few scenarios for an interval: five of five smaller ones are chance in one of 16 samples."""
        return self.count < FEWEST

    @property
    def failures(self) -> int:
        """Scenarios that ended early or diverged."""
        return sum(n for outcome, n in self.outcomes.items() if outcome != "finished")

    @property
    def failure_share(self) -> tuple[float, float]:
        """The exact interval of the share of failures, see `share_interval`."""
        return share_interval(self.failures, self.count)


def noun(named: bool) -> str:
    """Return what scenarios are called where they are named, and where they are not."""
    return "cases" if named else "scenarios"


def verdict(
    summaries: Sequence[Summary], skipped: Mapping[str, str], what: str = "scenarios", figure: Objective | None = None
) -> tuple[str, ...]:
    """Return sentences: every controller against the baseline, failures, and controllers that were not run.

    `figure`: by which controllers are compared; None: the relative error.
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
        which = "" if what == noun(True) else f"{noun(False).removesuffix('s')} "
        worst = (f"{s.name} {figure.text(s.worst)} in {which}{s.worst_name}" for s in summaries)
        sentences.append(f"Worst {what}: {'; '.join(worst)}.")
    sentences += [_failed(s, what) for s in summaries if s.failures]
    sentences += _nowhere([s for s in summaries if not s.failures], what)
    if skipped:
        sentences.append("Not run: " + "; ".join(f"{name} ({why})" for name, why in skipped.items()) + ".")
    return tuple(sentences)


def _sentence(baseline: Summary, one: Summary, what: str, figure: Objective) -> str:
    difference = one.difference
    assert difference is not None
    if one.equal == one.count and math.isinf(one.median):
        return f"{one.name} and {baseline.name} cannot be compared: neither has a finite {figure.noun} in any of the {what}."
    interval = "" if one.is_small else f", 95 % interval {figure.interval(difference.low, difference.high)}"
    equal = f", equal in {one.equal}" if one.equal else ""
    numbers = (
        f"median difference of {figure.subject} {figure.difference(difference.median)}{interval}; "
        f"{figure.better} in {one.better} of {counted(one.count, what)}{equal}"
    )
    if one.is_small:
        return f"{one.name} and {baseline.name} have too few {what} for an interval ({numbers})."
    more = figure.better == ("larger" if one.outcome is Outcome.BETTER else "smaller")
    told = not math.isnan(one.ratio) and (one.ratio > 1) == more
    times = f"; {one.ratio:.3g} times its {figure.noun}" if told else ""
    worse = "larger" if figure.better == "smaller" else "smaller"
    if one.outcome is Outcome.BETTER:
        return f"{one.name} has a {figure.better} {figure.noun} than {baseline.name} ({numbers}{times})."
    if one.outcome is Outcome.WORSE:
        return f"{one.name} has a {worse} {figure.noun} than {baseline.name} ({numbers}{times})."
    return f"{one.name} and {baseline.name} show no clear difference ({numbers})."


def counted(count: int, what: str) -> str:
    """Return so many of what there is: '1 scenario', '8 cases'."""
    return f"{count} {what.removesuffix('s') if count == 1 else what}"


def _failed(one: Summary, what: str) -> str:
    parts = [f"{n} {outcome}" for outcome, n in one.outcomes.items() if outcome != "finished"]
    said = f"{one.name} fails in {one.failures} of {counted(one.count, what)} ({', '.join(parts)})"
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
        f"{names} {verb} in none of {counted(none[0].count, what)}: in at most {most} of what is drawn so, with 95 % confidence."
    ]


RESAMPLES = 4000
LEVEL = 0.95
FEWEST = 6  # scenarios of which the sign test can reach that level: 2 / 2^n is smaller than 1 - LEVEL
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

    median: float
    low: float  # lower end of the interval
    high: float  # upper end of the interval


def median_interval(values: Quantiles, seed: int) -> ConfidenceInterval:
    """Return the median of `values` and its percentile bootstrap interval.

    Infinite values are allowed: they lie beyond all others. The interval is that of the population's median; with fewer than
    about ten values it is too narrow, and with fewer than `FEWEST` it is not told. Of many values the ends are those of infinitely
    many resamples: the median of one is at most the k-th value with the probability P(X >= n / 2), X binomial with n trials of
    k / n. They are further out by the places by which a value that is told may be wrong.

    References:
        B. Efron, R. J. Tibshirani, An Introduction to the Bootstrap, Chapman and Hall, 1993, chapter 13.
    """
    if values.count > _MANY:
        low, high = _ends_of_all_resamples(values.count)
        return ConfidenceInterval(values.median, values.at(low - values.error), values.at(high + values.error))
    random, numbers = np.random.default_rng(np.random.SeedSequence(seed)), values.numbers
    rows = max(1, _AT_ONCE // numbers.size)
    samples: list[np.ndarray] = []
    for at in range(0, RESAMPLES, rows):
        size = (min(rows, RESAMPLES - at), numbers.size)
        samples.append(middle(numbers[random.integers(numbers.size, size=size)]))
    medians = np.sort(np.concatenate(samples))
    tail = round((1 - LEVEL) / 2 * RESAMPLES)
    return ConfidenceInterval(values.median, float(medians[tail]), float(medians[-1 - tail]))


def _ends_of_all_resamples(size: int) -> tuple[int, int]:
    """Places, from 0, of the sorted values between which the median of a resample lies with probability `LEVEL`."""
    from scipy.special import bdtrc

    def at_most(k: int) -> float:
        return float(bdtrc(math.ceil(size / 2) - 1, size, k / size))

    shares = (1 - LEVEL) / 2, (1 + LEVEL) / 2
    low, high = (bisect_left(range(1, size), share, key=at_most) for share in shares)
    return low, high


def middle(values: np.ndarray) -> np.ndarray:
    """Median along the last axis; between minus and plus infinity lies zero."""
    size = values.shape[-1]
    places = [(size - 1) // 2, size // 2]
    low, high = np.moveaxis(np.partition(values, places, axis=-1)[..., places], -1, 0)
    with np.errstate(invalid="ignore"):
        between = 0.5 * low + 0.5 * high
    return np.where(low == high, low, np.where(np.isnan(between), 0.0, between))


_OF_METRICS = 2048  # numbers in a buffer of a metric, which has no interval beside it
_SHOWN = 4096  # scenarios at most whose errors are kept


def summarise(
    name: str,
    records: Iterable[Record],
    baseline: Iterable[Record] | None,
    seed: int,
    metrics: Sequence[Metric] | None = None,
    figure: Objective | None = None,
) -> Summary:
    """Return the summary of one controller's records against the baseline's of the same scenarios, in the same order.

    Without a baseline it is that of the baseline itself, without metrics that of the shipped and the installed ones, and without a
    figure that of the relative error. The seed is that of the resampling.
    """
    running = _Running(known_metrics() if metrics is None else metrics, figure or Objective())
    for record, before in zip(
        records, itertools.repeat(None) if baseline is None else baseline, strict=baseline is not None
    ):
        running.add(record, before)
    return running.summary(name, None if baseline is None else seed)


class _Running:
    """What was seen of the records so far."""

    def __init__(self, metrics: Sequence[Metric], figure: Objective) -> None:
        self._figure, self._error = figure, Objective()
        self._values, self._differences, self._ratios = Quantiles(), Quantiles(), Quantiles()
        self._numbers = {m.name: _Numbers(m.better) for m in metrics}
        self._shown = _Shown()
        self._outcomes, self._statuses = Counter[str](), Counter[str]()
        self._better = self._equal = 0
        self._negative = False  # of numbers such as a lowest level, of which a ratio can say the opposite
        self._worst, self._worst_of = -math.inf, ("", 0)
        self._first_ended: int | None = None

    def add(self, record: Record, before: Record | None) -> None:
        value, error = self._figure.value(record), self._error.value(record)
        other = value if before is None else self._figure.value(before)
        self._values.add(value)
        self._differences.add(0.0 if value == other else value - other)
        of_this, of_other = self._figure.amount(value), self._figure.amount(other)
        self._negative |= min(of_this, of_other) < 0
        self._ratios.add(0.0 if self._negative else _ratio(of_this, of_other))
        self._better += value < other
        self._equal += before is not None and value == other
        number = int(record["scenario"])
        if value > self._worst or not self._shown.count:
            self._worst, self._worst_of = value, (str(record.get("name", number)), number)
        if self._first_ended is None and record["outcome"] == "ended early":
            self._first_ended = number
        self._shown.add((number, error, value, record["mismatch"]))
        self._outcomes[str(record["outcome"])] += 1
        for metric, numbers in record["metrics"].items():
            if metric in self._numbers:
                self._numbers[metric].add(numbers)
        self._statuses.update(record["metrics"]["status"])

    def summary(self, name: str, seed: int | None) -> Summary:
        """The summary; without a seed that of the baseline."""
        scenarios, errors, values, mismatch = self._shown.columns()
        count, low = self._values.count, self._values.at((self._values.count - 1) // 2)
        with np.errstate(invalid="ignore"):
            away = np.where(values == low, 0.0, np.abs(values - low))
        worst = {metric: one.worst(count) for metric, one in self._numbers.items() if one.directed}
        medians = {metric: one.medians(count) for metric, one in self._numbers.items()}
        approximate = [self._values, self._differences, *(q for one in self._numbers.values() for q in one.quantiles)]
        return Summary(
            name=name,
            count=count,
            scenarios=scenarios.astype(int),
            errors=errors,
            values=values,
            mismatch=mismatch,
            rank_error=max(one.error / one.count for one in approximate),
            median=self._values.median,
            median_scenario=int(scenarios[int(np.nanargmin(away))]),
            worst=self._worst,
            worst_scenario=self._worst_of[1],
            worst_name=self._worst_of[0],
            first_ended=self._first_ended,
            metrics={metric: one for metric, one in medians.items() if one},
            worst_metrics={metric: one for metric, one in worst.items() if one},
            outcomes=dict(self._outcomes),
            statuses=dict(+self._statuses),
            difference=None if seed is None else median_interval(self._differences, seed),
            ratio=math.nan if self._negative else self._ratios.median,
            better=self._better,
            equal=self._equal,
        )


class _Numbers:
    """The numbers of one metric by element; a run without the number counts as worse than any other."""

    def __init__(self, better: str) -> None:
        self.directed, self._larger = better != "neither", better == "larger"
        self._lacking = -math.inf if self._larger else math.inf
        self._by_element: dict[str, Quantiles] = {}
        self._worst: dict[str, float] = {}

    @property
    def quantiles(self) -> Iterable[Quantiles]:
        return self._by_element.values()

    def add(self, numbers: Mapping[str, float | None]) -> None:
        for element, number in numbers.items():
            if element not in self._by_element:
                self._by_element[element], self._worst[element] = Quantiles(room=_OF_METRICS), -self._lacking
            value = self._lacking if number is None else number
            self._by_element[element].add(value)
            self._worst[element] = (min if self._larger else max)(self._worst[element], value)

    def worst(self, count: int) -> dict[str, float]:
        """The worst numbers of so many runs."""
        return {e: float(v if self._by_element[e].count == count else self._lacking) for e, v in self._worst.items()}

    def medians(self, count: int) -> dict[str, float]:
        """The medians of so many runs."""
        for one in self._by_element.values():
            while one.count < count:
                one.add(self._lacking)
        return {element: one.median for element, one in self._by_element.items()}


class _Shown:
    """Rows of all scenarios, or of every second, fourth and so on."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._every, self.count = 1, 0

    def add(self, row: tuple[float, ...]) -> None:
        if self.count % self._every == 0:
            if len(self._rows) >= _SHOWN:
                self._rows, self._every = self._rows[::2], 2 * self._every
            if self.count % self._every == 0:
                self._rows.append(row)
        self.count += 1

    def columns(self) -> Iterable[np.ndarray]:
        return np.array(self._rows, dtype=float).T


def _ratio(after: float, before: float) -> float:
    if after == before:
        return 1.0
    if before == 0:
        return math.inf
    ratio = after / before
    return 1.0 if math.isnan(ratio) else ratio
