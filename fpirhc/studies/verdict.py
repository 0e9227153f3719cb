"""The verdict: what adaptation does to a pair of controllers, as an outcome, a ratio per coordinate, and flags.

Controllers are compared and tuned by an `Objective`: the relative error, or any metric with a better direction. An outcome follows
from ratios of errors. A flag is a row of a table: what is measured, from when on it counts, and a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, derivative_of, nearest
from fpirhc.plant.motion import derivative_unit, with_space
from fpirhc.simulation.loop import HeldInput
from fpirhc.simulation.metrics import RELATIVE_ERROR, Metric, measured_cycles
from fpirhc.simulation.metrics.shipped import at_limits, rms_error
from fpirhc.simulation.simulate import simulator
from fpirhc.status import Status
from fpirhc.summary import in_percent, in_words, number, written_out
from fpirhc.symbolic.expression import TINY
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    from fpirhc.problem_files.problem_file import Task
    from fpirhc.studies.compare import Entry


PENALTY = 10.0  # relative error that no run can exceed, and beyond which one is lost
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
            return "none" if self.metric else "lost"
        if self.metric is None and value > PENALTY:
            return "lost"
        return in_percent(value) if self.metric is None else self.metric.text(value) + self._unit

    def difference(self, *values: float) -> str:
        """Return a difference of two numbers, or the ends of its interval, as text; infinite: one of the two runs is lost."""
        times, unit = (100, " points") if self.metric is None else (1, self._unit)
        lost = {self.sign * math.inf: "lost", -self.sign * math.inf: "other lost"}
        said = (lost.get(v, f"{'+' * (v > 0)}{written_out(times * v)}") for v in values if not math.isnan(v))
        return " to ".join(dict.fromkeys(said)) + unit * math.isfinite(values[-1])

    @property
    def _unit(self) -> str:
        return "" if self.unit in ("", "1") else with_space(self.unit)

    def value(self, row: Mapping[str, Any]) -> float:
        """Return the number of a row times `sign`: smaller is better, and infinite where the run failed or has none."""
        if row["outcome"] in ("ended early", "refused"):
            return math.inf
        if self.metric is not None and self.column not in row:
            names = [name for name in row if name.partition(".")[0] == self.metric.name]
            close = nearest(self.column, names) if names else ""
            raise InvalidName(f"metric '{self.column}': a run of '{row['controller']}' has none.{close}")
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
    names: Any = {None: (), "coordinate": problem.plant.followed, "input": problem.plant.inputs}
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


class Outcome(StrEnum):
    """The effect of adaptation on one pair of controllers; words and colours of every output follow from it."""

    BETTER = "better"
    WORSE = "worse"
    MIXED = "mixed"
    DOUBTFUL = "doubtful"  # a smaller error, and a reason why it is no success
    NO_DIFFERENCE = "no difference"
    NOT_COMPARABLE = "not comparable"
    LIMIT_LEFT = "violates a hard limit"  # of whatever error
    LEAVES = "violates a limit"  # of controllers, and of no pair
    NOT_GOOD = "not good yet"  # of one controller, whatever it is compared with


IN_FULL = None, Outcome.LEAVES, Outcome.NOT_GOOD  # of the sentences that short outputs show beside the first one


@dataclass(frozen=True)
class Finding:
    """One sentence of a verdict."""

    text: str
    outcome: Outcome | None = None  # of the pair that it is about; None for a remark
    pair: tuple[str, str] | None = None  # names without and with adaptation
    ratios: Mapping[str, float] = field(default_factory=dict)  # error with adaptation over that without, largest first
    price: str = ""  # the end of the text of one that is better: what it costs


HELPS, HURTS = 0.9, 1.1  # ratios below and above which an error has changed
NEAR = 1.2  # times the smallest error, below which another controller is named beside the best one
STILL = 1e-5  # of the limits' range, or of the rms command, in a cycle: what moves less stands still
WILD, TO_AND_FRO = 10.0, 10  # times the total variation of the partner, and its own range: chatter
UNSOLVED = 0.05  # of the plans
AT_LIMITS, REMAINS = 0.2, 0.1  # of the cycles, a command at a limit; of the motion, an error: what is more is not good
SWING = 0.05  # of the limits' range: as a sine from end to end in 11 cycles, or jumps between the ends every 10
MINOR, ROUNDING = 0.01, 1e-9  # of the largest relative error, and of the range, below which an error does not count
_SAMPLES = 2000


def left_alone(problem: Problem, seed: int) -> dict[str, float]:
    """Return the rms errors of the plant whose inputs are held; empty where it does not last, or is outside and so not run."""
    try:
        run = simulator(problem, HeldInput(), compiled=False).run(seed=seed) if problem.moves.simulated else None
    except FpirhcError:
        return {}
    return {} if run is None or run.stop is not None else rms_error(problem, run)


def ranges(problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
    """Return the range of every judged coordinate, and the size of the set-point of those that rest.

    The range is that of the reference, or how far the start is from it where that is more. Of one that starts where it rests it is
    the error that weighs one in the cost, or the distance of its limits, or 1.
    """
    plant, times = problem.plant, np.linspace(0.0, problem.duration, _SAMPLES)
    rows = np.asarray(problem.reference.function(plant).map(_SAMPLES)(times[None, :])[0].full())
    weights = problem.cost.tracked or {} if problem.cost is not None else {}
    found, resting = dict[str, float](), dict[str, float]()
    for name in problem.judged_names:
        place, (low, high) = plant.output.elements.index(name), problem.limits.states.get(name, (0.0, 1.0))
        size, span = float(np.abs(rows[place]).max()), float(np.ptp(rows[place]))
        found[name] = max(span, abs(float(rows[place, 0] - problem.start_output[place])))
        small = ROUNDING * size
        if found[name] <= small:
            wide = high - low
            found[name] = weights[name] ** -0.5 if weights.get(name) else wide if math.isfinite(wide) else 1.0
        resting |= {name: size} if span <= small else {}
    return found, resting


@dataclass(frozen=True)
class Yardstick:
    """What errors are measured against, by judged coordinate."""

    problem: Problem
    scales: Mapping[str, float]  # the ranges
    alone: Mapping[str, float]  # rms error of the plant left alone; empty where it is not known
    resting: Mapping[str, float]  # the set-point's size of what rests; under disturbances, of the movement left alone

    @staticmethod
    def of(problem: Problem, seed: int) -> Yardstick:
        """Return the yardstick of a problem."""
        (scales, sizes), alone = ranges(problem), left_alone(problem, seed)
        resting = {n: max(s, alone.get(n, s)) if problem.disturbances or not s else s for n, s in sizes.items()}
        return Yardstick(problem, scales, alone, resting)

    def beyond(self, entry: Entry, name: str) -> bool:
        """Whether an error is larger than the motion itself, and than what stands for it where nothing is to move."""
        return entry.errors[name] > self._motion(name)

    def _motion(self, name: str) -> float:
        return max(one[name] for one in (self.scales, self.resting) if name in one)

    def shortfalls(self, entry: Entry, by_error: bool) -> list[tuple[str, str]]:
        """Return what is not good yet of a run that ends: in the words of a table, and of a sentence."""
        shares = self._remains(entry) if by_error else 0.0, entry.metrics["at_limit"][""]
        error, stands = map(in_percent, shares)
        far = f"errs {error}", f"still errs by {error} of the motion in the second half"
        stuck = f"at a limit in {stands} of the cycles", f"stands at a limit in {stands} of the cycles"
        return [far] * (REMAINS < shares[0] < math.inf) + [stuck] * (shares[1] > AT_LIMITS)

    def _remains(self, entry: Entry) -> float:
        """The rms error in the second half of the cycles that count, when a start is over, as a share of the motion."""
        counted, errors = np.flatnonzero(measured_cycles(self.problem, entry.run)), np.abs(entry.run["true_error"])
        late, sizes = errors[counted[len(counted) // 2 :]], dict[str, float]()
        for name, first in zip(self.problem.judged_names, errors[0], strict=True):
            steps = not self.problem.disturbances and first > 0.99 * self.scales[name]  # from the start to a set-point
            sizes[name] = self.scales[name] if steps else self._motion(name)
        every = dict(zip(sizes, np.sqrt((late**2).sum(axis=0) / max(len(late), 1)).tolist(), strict=True))
        return relative({n: v for n, v in every.items() if entry.weighed is None or n in entry.weighed}, sizes)


@dataclass(frozen=True, eq=False)
class Pair:
    """The same controller without adaptation and with it, and what is asked of them."""

    plain: Entry
    adaptive: Entry
    yard: Yardstick
    names: Sequence[str]  # of the coordinates that count


def _left_alone(pair: Pair) -> float:
    alone = pair.yard.alone
    return min((pair.adaptive.errors[n] / alone[n] for n in pair.names if alone.get(n)), default=math.nan)


def _growth(pair: Pair) -> float:
    """By how much the error grows from quarter to quarter of the run, as that of an unstable loop."""
    errors = np.abs(pair.adaptive.run["true_error"])
    if len(errors) < 40:
        return math.nan
    largest = np.array([part.max(axis=0) for part in np.array_split(errors, 4)])
    steps = largest[1:] / np.maximum(largest[:-1], TINY)
    exponential = (steps[0] > 1) & (steps[1:] >= 1.5).all(axis=0) & (steps[-1] >= 0.6 * steps[0])
    return max((largest[-1] / np.maximum(largest[0], TINY))[exponential], default=math.nan)


def _moves(own: Mapping[str, Any], plain: Mapping[str, Any], problem: Problem, ways: float = 0.0) -> float:
    """How many times as much an input moves, by rows of runs, of those that move `ways` times their range; at rest by STILL."""
    (low, high), times = problem.limits.input_bounds(problem.plant), [0.0]
    for name, size in zip(problem.plant.inputs, (high - low).tolist(), strict=True):
        moved, before = (row[f"total_variation.{name}"] for row in (own, plain))
        if moved > 0 and moved * (problem.duration - problem.measure_from) >= ways * own[f"command_range.{name}"]:
            size = size if math.isfinite(size) else own[f"effort.{name}"]
            times.append(moved / max(before, STILL / problem.period * size))
    return max(times)


def chatter(own: Mapping[str, Any], plain: Mapping[str, Any], problem: Problem) -> float:
    """Return how many times as much as its partner's a command moves, by rows of runs; 0 where none chatters."""
    times = _moves(own, plain, problem, ways=TO_AND_FRO)
    return times if times > WILD else 0.0


def _of_pair(measure: Callable[..., float], pair: Pair) -> float:
    own, plain = ({m.key(e): v for m, e, v in one.metrics.rows()} for one in (pair.adaptive, pair.plain))
    return measure(own, plain, pair.yard.problem)


_moved, _chatters = partial(_of_pair, _moves), partial(_of_pair, chatter)


def _swing(pair: Pair) -> float:
    """How far both commands are from the mean of those before and after, as a share of the limits' range."""
    problem, runs = pair.yard.problem, (pair.plain.run, pair.adaptive.run)
    low, high = problem.limits.input_bounds(problem.plant)
    bends = [np.abs(np.diff(run["command"][measured_cycles(problem, run)], 2, axis=0)) / 2 for run in runs]
    far = np.min([one.sum(axis=0) / max(len(one), 1) for one in bends], axis=0)
    return float((far / np.maximum(high - low, TINY)).max(initial=0.0))


def _at(pair: Pair) -> str:
    """The limit at which a command stands most."""
    problem, run = pair.yard.problem, pair.adaptive.run
    every, values = (at_limits(problem, run, rates=one).mean(axis=0) for one in (True, False))
    k = int(every.argmax())
    rate, (name, unit) = bool(values[k] < every[k] / 2), [*problem.plant.inputs.items()][k]
    ends = (problem.limits.rate_bounds if rate else problem.limits.input_bounds)(problem.plant)
    unit = with_space(derivative_unit(unit, int(rate), problem.time_unit))
    return f"its {'rate' if rate else 'value'} ({name}: {number(ends[0][k])} to {number(ends[1][k])}{unit})"


def _not_finite(pair: Pair) -> float:
    planned = [e.run["solve.status"] for e in (pair.plain, pair.adaptive) if "solve" in e.run.layout]
    return max((float(np.mean(status == Status.NON_FINITE)) for status in planned), default=math.nan)


def _null(pair: Pair, *, lost: bool = False) -> float:
    """How many times as large it makes the error of a right model, where the null test fails; 1 where it is `lost`."""
    null = pair.adaptive.null
    if null is None or null.stuck or not null.fails(pair.plain.errors):
        return math.nan
    beyond = any(null.adapted[n] > PENALTY * pair.yard.scales[n] for n in null.adapted)
    return math.nan if beyond != lost else 1.0 if lost else null.ratio(null.worst)


_diverges = partial(_null, lost=True)


@dataclass(frozen=True)
class Flag:
    """A row of the table of flags."""

    measure: Callable[[Pair], float]  # NaN: there is nothing to measure
    least: float  # value from which it is raised
    text: str  # with the {value}, and the share of cycles at a limit {before}
    doubts: bool = False  # whether it turns a smaller error into a doubtful one


NULL = "its own model as the plant, the problem's sensors and no disturbances"
_HARMS = f"with {NULL} its rms error is {{value}} times that without adaptation"
FLAGS = (  # of rows with one measure the first that is raised
    Flag(_left_alone, 1.0, "it is no better than doing nothing: its rms error is {value:%} of that with commands held", True),
    Flag(_growth, 8.0, "its error grows {value} times from the first quarter of the run to the last: as in an unstable loop", True),
    Flag(lambda pair: pair.adaptive.metrics["status"][Status.NOT_CONVERGED.name] / pair.adaptive.run.cycles, UNSOLVED,
         "{value:%} of its plans did not converge: give the optimiser more iterations", True),
    Flag(_not_finite, UNSOLVED, "in {value:%} of cycles a plan met nan, and the last plan went on: look at roots and divisions "
         "in the response", True),
    Flag(lambda pair: pair.adaptive.metrics["at_limit"][""], AT_LIMITS,
         "its command is at a limit of {at}, where nothing adapts, in {value:%} of cycles (without it {before:%})", True),
    Flag(_swing, SWING, "both commands swing from cycle to cycle, by {value:%} of their limits' range on average", True),
    Flag(_chatters, WILD, "its command varies {value} times as much as without adaptation: it chatters, see fpirhc review", True),
    Flag(_moved, 2.0, "the total variation of its command is {value} times that without adaptation"),
    Flag(lambda pair: math.nan if pair.adaptive.contraction is None else pair.adaptive.contraction.growing, 0.05,
         "its contraction factor is above 1 in {value:%} of the cycles: see the gain in fpirhc review"),
    Flag(_diverges, 0.0, f"with {NULL} it diverges", True),
    Flag(_null, 10.0, _HARMS, True),
    Flag(_null, 0.0, _HARMS),
)  # fmt: skip


def flags_of(pair: Pair) -> list[tuple[Flag, str]]:
    """Return the flags that are raised for a pair, each with its sentence."""
    every, before = [(flag, flag.measure(pair)) for flag in FLAGS], pair.plain.metrics["at_limit"][""]
    said = [(f, in_words(f.text, {"value": v, "before": before}, {}, at=_at(pair))) for f, v in every if v > f.least]
    raised = {one[0].measure: one for one in reversed(said)}
    return [one for what, one in reversed(raised.items()) if what is not _moved or _chatters not in raised]


def by_reason(reasons: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the names of controllers by the reason that they have in common."""
    return {why: [name for name, one in reasons.items() if one == why] for why in reasons.values()}


def judge(plain: Entry, adaptive: Entry, yard: Yardstick) -> Finding:
    """Return what adaptation does to one pair."""
    names = plain.name, adaptive.name
    ended = {e.name: e.run.stop for e in (plain, adaptive) if e.run.stop is not None}
    if ended:
        outcome = _of_lost(ended, adaptive)
        texts = [f"{' and '.join(n)} do{'es' * (len(n) == 1)} not finish: {why}" for why, n in by_reason(ended).items()]
        return Finding(f"{'; '.join(texts)}.", outcome, names)
    before, after, run = plain.errors, adaptive.errors, adaptive.run
    counted = [n for n in before if adaptive.weighed is None or n in adaptive.weighed] or list(before)
    if not all(math.isfinite(before[n] + after[n]) for n in counted):
        text = f"{names[1]} and {names[0]} cannot be compared: an error is no number."
        return Finding(text, Outcome.NOT_COMPARABLE, names)
    share = {n: (before[n] / yard.scales[n], after[n] / yard.scales[n]) for n in counted}
    least = MINOR * min(max(s[k] for s in share.values()) for k in (0, 1))
    major = [n for n in counted if max(share[n]) >= max(least, ROUNDING)]
    ratios = {n: after[n] / before[n] if before[n] else math.inf if after[n] else math.nan for n in major}
    ratios = dict(sorted(ratios.items(), key=lambda pair: -pair[1]))
    up, down = any(r > HURTS for r in ratios.values()), any(r < HELPS for r in ratios.values())
    one_way = Outcome.WORSE if up else Outcome.BETTER if down else Outcome.NO_DIFFERENCE
    outcome = Outcome.MIXED if up and down else one_way
    raised = flags_of(Pair(plain, adaptive, yard, major))
    said = [text for _, text in raised]
    if any(yard.beyond(plain, n) and yard.beyond(adaptive, n) for n in major):
        outcome, said = Outcome.NOT_COMPARABLE, [*said, "neither follows the reference"]
    elif outcome is Outcome.BETTER and any(flag.doubts for flag, _ in raised):
        outcome = Outcome.DOUBTFUL
    units = {n: with_space(run.unit(f"error.{n}")) for n in ratios}
    errors = ", ".join(f"{n} {written_out(before[n])} -> {written_out(after[n])}{unit}" for n, unit in units.items())
    broken = f"violates the hard limit of {adaptive.left[0].name}" if adaptive.left else ""
    outcome = Outcome.LIMIT_LEFT if broken else outcome
    text = f"{names[1]} against {names[0]}: {broken or outcome} (rms error {errors or 'of rounding'})."
    more = " ".join(f"{s[0].upper()}{s[1:]}." for s in said)
    return Finding(f"{text} {more}".rstrip(), outcome, names, ratios, more if outcome is Outcome.BETTER else "")


def _of_lost(lost: Collection[str], adaptive: Entry) -> Outcome:
    """The outcome of a pair of which one or both have no number."""
    kept = Outcome.LIMIT_LEFT if adaptive.left else Outcome.BETTER
    return Outcome.NOT_COMPARABLE if len(lost) == 2 else Outcome.WORSE if adaptive.name in lost else kept


def judge_by(aim: Objective, plain: Entry, adaptive: Entry) -> Finding:
    """Return what adaptation does to the number that the problem is judged by."""
    names, metric, both = (plain.name, adaptive.name), aim.metric, (plain, adaptive)
    assert metric is not None
    before, after = (math.nan if e.run.stop else float(e.metrics[metric.name].get(aim.element, math.nan)) for e in both)
    lost = [n for n, v in zip(names, (before, after), strict=True) if not math.isfinite(v)]
    if lost:
        return Finding(f"{' and '.join(lost)}: no {aim.column}.", _of_lost(lost, adaptive), names)
    ratio = after / before if before * after > 0 else math.nan
    if abs(after - before) <= metric.floor or HELPS <= ratio <= HURTS:
        outcome = Outcome.NO_DIFFERENCE
    else:
        outcome = Outcome.BETTER if aim.sign * after < aim.sign * before else Outcome.WORSE
    broken = f"violates the hard limit of {adaptive.left[0].name}" if adaptive.left else ""
    outcome = Outcome.LIMIT_LEFT if broken else outcome
    change = f"{aim.text(before)} -> {aim.text(after)}"
    text = f"{names[1]} against {names[0]} by {aim.column}: {broken or outcome} ({change})."
    return Finding(text, outcome, names, {aim.column: ratio})


def leaves(entries: Sequence[Entry]) -> str:
    """Return who violates a hard limit, of several the worst: every limit once, with all names and the worst number."""
    worst, said = {e.name: e.left[0] for e in entries if e.left}, list[str]()
    for limit in dict.fromkeys(one.name for one in worst.values()):
        names = sorted((n for n in worst if worst[n].name == limit), key=lambda n: -worst[n].beyond.max())
        one, whose = len(names) == 1, f" of {names[0]}"
        said.append(f"{', '.join(names)} violate{'s' * one} a limit: {worst[names[0]].sentence}{'' if one else whose}.")
    return " ".join(said)


def findings(
    entries: Sequence[Entry], task: Task, yard: Yardstick, skipped: Mapping[str, str], causes: Sequence[str]
) -> tuple[Finding, ...]:
    """Return the verdict: what the file says, the headline pair, then the others, the best row, and what was not run."""
    by_name, aim = {e.name: e for e in entries}, objective(task.headline_metric, task.metrics, task.problem)
    pairs = [(by_name[e.pair], e) for e in entries if e.pair in by_name]
    pairs.sort(key=lambda p: ((p[0].name, p[1].name) != task.headline, "solve" not in p[1].run.layout))
    judged = [judge_by(aim, *pair) for pair in pairs] if aim.metric is not None else []
    judged += [judge(*pair, yard) for pair in pairs]
    if not judged:
        judged = [Finding("No controller is here both with and without adaptation.", Outcome.NOT_COMPARABLE)]
    left, first = leaves(entries), judged[0]
    own = any(by_name[name].left for name in first.pair or ())
    judged[0] = replace(first, text=" ".join([*causes, *[left] * own, first.text.removesuffix(first.price).rstrip()]))
    judged += [Finding(left, Outcome.LEAVES)] * bool(left and not own)
    judged[1:1] = [*_not_good(first, by_name, yard, aim.metric is None), *[Finding(first.price)] * bool(first.price)]
    judged += [Finding(text) for text in _remarks(entries, pairs[0][1] if pairs else None, yard, bool(causes))]
    return (*judged, *(Finding(f"Not run: {', '.join(names)} ({why}).") for why, names in by_reason(skipped).items()))


def _not_good(first: Finding, entries: Mapping[str, Entry], yard: Yardstick, by_error: bool) -> list[Finding]:
    """A sentence about the better one of the first pair; of two that are alike, about the simpler one."""
    if first.pair is None or first.outcome in (Outcome.NOT_COMPARABLE, Outcome.LIMIT_LEFT):
        return []
    name = first.pair[first.outcome in (Outcome.BETTER, Outcome.DOUBTFUL, Outcome.MIXED)]
    texts = [text for _, text in yard.shortfalls(entries[name], by_error)]
    return [Finding(f"{name} {' and '.join(texts)}.", Outcome.NOT_GOOD)] if texts else []


def follows(entry: Entry, yard: Yardstick) -> bool:
    """Whether a run ends, with no error larger than the motion, and not all of them as large as those of the plant left alone."""
    names = entry.weighed or entry.errors
    idle = [entry.errors[n] >= yard.alone[n] for n in names if yard.alone.get(n)]
    return entry.run.stop is None and not any(yard.beyond(entry, n) for n in names) and not (idle and all(idle))


def relative(errors: Mapping[str, float], sizes: Mapping[str, float]) -> float:
    """Return the rms errors over these sizes, root mean square over the coordinates; infinite where one is no number."""
    shares = [rms / sizes[c] for c, rms in errors.items()]
    error = math.hypot(*shares) / math.sqrt(len(shares))
    return error if math.isfinite(error) else math.inf


def _remarks(entries: Sequence[Entry], first: Entry | None, yard: Yardstick, told: bool) -> Iterator[str]:
    names = (first.weighed if first else None) or [*yard.scales]
    rows = {e.name: relative({n: e.errors[n] for n in names}, yard.scales) for e in entries if e.run.stop is None}
    fair = {e.name: rows[e.name] for e in entries if not e.exact and math.isfinite(rows.get(e.name, math.inf))}
    if fair and not any(follows(e, yard) for e in entries):
        yield f"No controller follows{'' if told else '; fpirhc review says why'}."
    elif fair and not (first and len(fair) == len(entries) == 2):  # the sentence of the only pair has both errors
        (least, best), *rest = sorted((v, n) for n, v in fair.items())
        among = " with the wrong model" * any(e.exact for e in entries)
        others = "".join(f"; {n} is within {math.ceil(100 * (v / least - 1))} %" for v, n in rest if v < NEAR * least)
        yield f"Smallest rms error{among}: {best}, {in_percent(least)} of the motion{others}."
