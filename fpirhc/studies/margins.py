"""How much of something a controller, which knows nothing of it, bears before it fails: one quantity is doubled and halved."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, nearest
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import AboveZero, Seed
from fpirhc.problem_files.problem_file import Task, pair_of
from fpirhc.sensing.sensing import FAULTS, Sensor
from fpirhc.simulation.metrics import Metric, measured_cycles
from fpirhc.simulation.ranges import hard_limits
from fpirhc.simulation.run import Run
from fpirhc.studies import Progress, Study, View, circumstances
from fpirhc.studies.compare import check_gains, select
from fpirhc.studies.runs import Kept, Row, Runner, header_of
from fpirhc.studies.variants import Draws, Variant
from fpirhc.studies.verdict import AT_LIMITS, HELPS, Objective, chatter, ranges
from fpirhc.summary import Column, Table, in_percent, written_out
from fpirhc.task.problem import Problem

FAILS = 0.5  # relative error from which a run has failed, where nothing else is said
PLANTS = 100  # drawn for every percent of 'plants'
_NEAR, _HALVINGS = 1.05, 14
_OUTSIDE = 0.02  # of a limit's range: what is farther outside has left it
_FARTHEST = 128  # cycles of latency
_MEASURED = "rms_error", "total_variation", "effort", "command_range", "at_limit"


@dataclass(frozen=True)
class Quantity:
    """What grows: from `start`, in steps that begin with `first`, up to `most`."""

    unit: str
    start: float
    first: float
    most: float
    at: Callable[[float], Sequence[Variant]]  # the variants of which none may fail
    whole: bool = False  # whether values are whole multiples of the first one


def _one(problem: Problem, seed: int, key: object, built: Problem, believed: Problem) -> list[Variant]:
    return [Variant(f"{key}", problem, key, seed=seed, built=built, believed=believed)]


def _mismatch(problem: Problem, seed: int) -> Quantity:
    known = {n: p.approximate for n, p in problem.plant.parameters.items()}
    exact = np.array([p.exact for p in problem.moves.parameters.values()])
    model = np.array([known.get(n, p.exact) for n, p in problem.moves.parameters.items()])
    if np.array_equal(exact, model):
        raise InvalidValue("the model is right")
    scaled = exact * model > 0
    ratios = np.log(np.where(scaled, exact, 1.0) / np.where(scaled, model, 1.0))

    def at(share: float) -> list[Variant]:
        values = np.where(scaled, model * np.exp(share * ratios), model + share * (exact - model))
        return _one(problem.with_exact(values), seed, None, problem, problem)

    return Quantity("of the file's", 1.0, 2.0, _existing(at, 1.0, 64.0), at)


def _existing(at: Callable[[float], object], low: float, high: float) -> float:
    """The largest value whose problem exists: parameters have bounds, and a response an inverse."""

    def exists(value: float) -> bool:
        try:
            at(value)
        except FpirhcError:
            return False
        return True

    if exists(high):
        return high
    while high > 1.01 * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if exists(middle) else (low, middle)
    return low


def _latency(problem: Problem, seed: int) -> Quantity:
    times, period = problem.dead_time, problem.period

    def at(value: float) -> list[Variant]:
        inputs = {n: times.inputs.get(n, 0.0) + value for n in problem.plant.inputs}
        late = {"inputs": inputs} if problem.moves.simulated else {"measurement": times.measurement + value}
        later = replace(problem, dead_time=replace(times, **late))
        return _one(later, seed, ("latency", value), later, problem)

    most = min(_FARTHEST, max(problem.cycles // 4, 1))
    return Quantity(problem.time_unit, 0.0, period, period * most, at, whole=True)


def _sensed(word: str, problem: Problem, seed: int) -> Quantity:
    fault, sizes, sensing = FAULTS[word], ranges(problem)[0], problem.sensing
    names = sensing.measures(problem.plant)

    def at(value: float) -> list[Variant]:
        own = {n: fault.of(sensing.sensors.get(n, Sensor()), value, sizes.get(n, 0.0), len(names)) for n in names}
        sensed = replace(problem, sensing=replace(sensing, sensors={**sensing.sensors, **own}))
        return _one(sensed, seed, (word, value), sensed, problem)

    return Quantity(fault.unit, 0.0, fault.first, fault.most, at)


def _plants(problem: Problem, seed: int) -> Quantity:
    def at(percent: float) -> Sequence[Variant]:
        return Draws(PLANTS if percent else 1, percent, seed).of_problem(problem)

    return Quantity("% around the exact parameters", 0.0, 8.0, _existing(at, 1e-3, 99.0), at)


QUANTITIES: Mapping[str, tuple[Callable[[Problem, int], Quantity], str]] = {  # and what grows, in words
    "mismatch": (_mismatch, "of all parameters, in % of that in the file, up to 6 400 %; 200 %: factors squared"),
    "plants": (_plants, f"{PLANTS} plants are drawn within this width, none of which may fail, up to 99 %"),
    "latency": (_latency, f"commands come later by whole cycles, up to {_FARTHEST}"),
    **{word: (partial(_sensed, word), fault.told) for word, fault in FAULTS.items()},
}


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Margins(Study):
    """The result of `margins`.

    Args:
        table: a row per controller and quantity: unit, holds (NaN where the problem as it stands fails), error (largest relative
            one there), fails (infinite where nothing does), and why.
        fails: relative error from which a run has failed.
        tried: by quantity and controller the values that were tried, each with the row of the run with the largest error there.
        beats: by quantity what is said of each that adapts: up to which of these it beats its partner.
    """

    table: pd.DataFrame
    fails: float
    tried: Mapping[str, Mapping[str, Mapping[float, Row]]]
    beats: Mapping[str, Sequence[str]]

    @property
    def view(self) -> View:
        heads = ("controller", "what grows", "holds at", "error there", "fails at", "why")
        shown = Table(f"{self.problem}: where controllers fail", [Column(c, left=c == "why") for c in heads], names=2)
        rows: Iterator[Any] = self.table.itertuples()
        borne, grown, tables = dict[str, list[str]](), dict[str, tuple[str, int]](), [shown]
        for row in rows:
            share = row.unit.startswith("of ")  # of the range, of the samples
            holds, fails = (written_out(100 * value if share else value) for value in (row.holds, row.fails))
            where = f"at {_with_unit(row.fails, row.unit)}"
            if math.isnan(row.holds):
                holds, fails, where = "none", "as it stands" if row.unit else fails, "as it stands"
            elif row.fails > 1e300:
                fails, where = "none tried", "nowhere that is tried"
            what = f"{row.quantity} [{'% ' * share}{row.unit}]" if row.unit else row.quantity
            there = "" if math.isnan(row.error) else in_percent(row.error)
            shown.add([row.controller, what, holds, there, fails, row.why])
            if row.unit:
                grown[row.quantity] = what, 100 if share else 1
                borne.setdefault(row.quantity, [*self.beats[row.quantity]]).append(f"{row.controller} fails {where}")
        grows = " ".join(f"{name.capitalize()}: {QUANTITIES[name][1]}." for name in dict.fromkeys(self.table.quantity))
        about = (
            f"One quantity grows until a run fails; the margin is found to 5 %. {grows} A run fails if it ends early, violates a "
            f"hard limit by {in_percent(_OUTSIDE)} of its range, or has an error above {in_percent(self.fails)} of the "
            "reference's range. What holds may have a large error. A controller beats its partner where its error is a tenth "
            "smaller, and its command neither chatters nor stands at limits."
        )
        for what, (head, times) in grown.items():
            known = self.tried[what]
            values = sorted(set.intersection(*map(set, known.values())))  # at which all controllers were tried
            tables.append(Table(f"error at {head}", [Column(text) for text in (head, *known)]))
            for value in values:
                errors = (Objective().text(tried[value]["error"]) for tried in known.values())
                tables[-1].add([written_out(times * value), *errors])
        facts = {"margins": self.table.to_dict("records"), "fails": self.fails, "versions": self.versions}
        sentences = [(f"{q.capitalize()}: {'; '.join(some)}.", None) for q, some in borne.items()]
        return View(self, sentences, about, tables, facts)


@checked_call
def margins(
    task: Task,
    *,
    over: Sequence[str] | None = None,
    controllers: Sequence[str] | None = None,
    fails: AboveZero = FAILS,
    seed: Seed = 0,
    compiled: bool = True,
    folder: Path | None = None,
    command: str = "",
    progress: Progress | None = None,
) -> Margins:
    """Return for every controller how much it bears, to 5 %, and what fails there.

        mismatch    f: exact = approximate (exact / approximate)^f of all parameters; 1 is the problem's own.
                    Where one is 0 or the signs differ: approximate + f (exact - approximate)
        noise       deviation of white noise on every measured quantity, as a share of its range along the reference

    Args:
        task: a problem with its controllers.
        over: names of quantities: mismatch, plants, latency, noise, lost; None: all.
        controllers: names; None: all.
        fails: relative error from which a run has failed.
        seed: of noise, lost samples and plants, the same in all runs.
        compiled: whether loops run as compiled C.
        folder: of finished margins, which the same call does not search again.
        command: that reproduces it.
        progress: called with (controller, quantities done, in all).

    Raises:
        InvalidName: no such quantity or controller; the nearest one is offered.
    """
    begin, chosen = time.perf_counter(), select(task, controllers)
    check_gains(task, chosen)
    wanted = list(over or QUANTITIES)
    for name in [one for one in wanted if one not in QUANTITIES]:
        raise InvalidName(f"quantity '{name}' is unknown.{nearest(name, QUANTITIES)}")
    metrics = [*(m for m in task.metrics if m.name in _MEASURED), Metric("outside", _outside)]
    header = header_of(replace(task, controllers=chosen), {"kind": "margins", "fails": fails, "seed": seed}, metrics)
    with Kept(folder and folder / "margins.jsonl", header) as kept:
        rows = {(row["controller"], row["quantity"]): row for row in kept.rows}
        for name in chosen:
            runner = Runner(task, name, metrics, compiled=compiled)
            for done, what in enumerate(wanted, 1):
                if (name, what) not in rows:
                    found = {"controller": name, "quantity": what, **_limit(task.problem, what, seed, runner, fails)}
                    rows[name, what] = found
                    kept.append(found)
                if progress:
                    progress(name, done, len(wanted))
    tried = {what: {name: dict(rows[name, what].pop("tried", ())) for name in chosen} for what in wanted}
    table = pd.DataFrame([rows[name, what] for name in chosen for what in wanted])
    pairs = [(name, plain) for name in chosen if (plain := pair_of(chosen, name)) not in (None, name)]
    told = {what: [_beats(task.problem, pair, rows[pair[0], what], tried[what]) for pair in pairs] for what in wanted}
    return Margins(table=table, fails=fails, tried=tried, beats=told, **circumstances(task, chosen, command, begin))


def _beats(problem: Problem, pair: tuple[str, str], row: Row, tried: Mapping[str, Mapping[float, Row]]) -> str:
    """Up to which value that both were tried at a controller beats its partner, and what it has at the next one."""
    upto, why, (name, partner) = "", "", pair
    for value in sorted(tried[name].keys() & tried[partner].keys()):
        own, plain, where = tried[name][value], tried[partner][value], _with_unit(value, row["unit"])
        if not own["error"] < HELPS * plain["error"]:
            why = f"its error is {Objective().text(own['error'])}, with {partner} {Objective().text(plain['error'])}"
        elif times := chatter(own, plain, problem):
            why = f"it chatters, with {written_out(times)} times the total variation of {partner}"
        elif own["at_limit"] > AT_LIMITS:
            why = f"its command is at a limit in {in_percent(own['at_limit'])} of cycles"
        if why:
            return f"{name} {f'beats {partner} up to {upto}, and not' if upto else f'does not beat {partner}'} at {where}: {why}"
        upto = where
    return f"{name} beats {partner} up to {upto}"


def _with_unit(value: float, unit: str) -> str:
    share = unit.startswith("of ")
    return f"{written_out(100 * value if share else value)} {'% ' * share}{unit}"


def _outside(problem: Problem, run: Run) -> float:
    """By how much a hard limit is left where errors count, as a share of its range."""
    late = measured_cycles(problem, run)
    return max((float(one.beyond[late].max(initial=0.0)) for one in hard_limits(problem, run)), default=0.0)


def _why(row: Row, fails: float) -> str:
    """Why a run failed; empty where it did not."""
    if row["why"]:
        return str(row["why"]).partition(";")[0]
    if row["outside"] > _OUTSIDE:
        return "a hard limit is left"
    return "" if row["error"] <= fails else f"its error is {Objective().text(row['error'])}"


def _limit(problem: Problem, what: str, seed: int, runner: Runner, fails: float) -> Mapping[str, object]:
    reasons, worst = dict[float, str](), dict[float, Row]()

    def failed(value: float) -> bool:
        if value not in reasons:
            try:
                rows = [*runner.rows(quantity.at(value))]
                worst[value] = max(rows, key=lambda row: float(row["error"]))
                reasons[value] = next(filter(None, map(partial(_why, fails=fails), rows)), "")
            except FpirhcError as error:
                if value <= quantity.first:
                    raise
                reasons[value] = str(error)
        return bool(reasons[value])

    try:
        quantity = QUANTITIES[what][0](problem, seed)
        start = failed(quantity.start)
        holds, ends = (math.nan, quantity.start) if start else bracket(failed, quantity)
    except FpirhcError as error:
        return {"unit": "", "holds": math.nan, "error": math.nan, "fails": math.nan, "why": f"not tried: {error}"}
    there = worst[holds]["error"] if holds in worst else math.nan
    row = {"unit": quantity.unit, "holds": holds, "error": there, "fails": ends}
    return row | {"why": reasons.get(ends, ""), "tried": [*worst.items()]}


def bracket(failed: Callable[[float], bool], of: Quantity) -> tuple[float, float]:
    """Return the largest value that holds and the smallest one that fails, by doubling and halving; infinity where none fails."""
    holds, fails = of.start, min(of.first, of.most)
    while not failed(fails):
        if fails >= of.most:
            return fails, math.inf
        holds, fails = fails, min(2 * fails, of.most)
    for _ in range(_HALVINGS):
        if fails <= _NEAR * holds or (of.whole and fails - holds < 1.5 * of.first):
            break
        middle = math.sqrt(holds * fails) if holds > 0 else fails / 2
        if of.whole:
            middle = of.first * round((holds + fails) / 2 / of.first)
        holds, fails = (holds, middle) if failed(middle) else (middle, fails)
    return holds, fails
