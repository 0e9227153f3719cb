"""How much of something a controller bears before it fails: doubling and halving of one quantity, a row for every run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from fpirhc.controllers.contract import believing
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, nearest
from fpirhc.fields.checked import checked_call
from fpirhc.problem_files.problem_file import Task
from fpirhc.sensing.sensing import Sensor
from fpirhc.studies.comparison.compare import check_gains, select
from fpirhc.studies.variants import Draws, Runner, Variant, ranges
from fpirhc.studies.view import Progress, Study, View, circumstances
from fpirhc.summary import Column, Table, in_percent, number
from fpirhc.task.disturbance import Noise
from fpirhc.task.problem import Problem

FAILS = 0.5  # rms error from which a run has failed, as a share of the reference's range
_NEAR, _HALVINGS = 1.05, 14
PLANTS = 100  # drawn for every percent of 'plants'


@dataclass(frozen=True)
class Quantity:
    """What grows: from `start`, in steps that begin with `first`, up to `most`."""

    unit: str
    start: float
    first: float
    most: float
    at: Callable[[float], Sequence[Variant]]


def _one(problem: Problem, key: object) -> list[Variant]:
    return [Variant("", problem, key)]


def _mismatch(problem: Problem) -> Quantity:
    known = {n: p.approximate for n, p in problem.plant.parameters.items()}
    exact = np.array([p.exact for p in problem.moved.parameters.values()])
    model = np.array([known.get(n, p.exact) for n, p in problem.moved.parameters.items()])
    if np.array_equal(exact, model):
        raise InvalidValue("the model is right")
    ratios = np.where(exact * model > 0, np.log(np.abs(exact / np.where(model, model, 1.0))), 0.0)

    def at(share: float) -> list[Variant]:
        values = np.where(exact * model > 0, model * np.exp(share * ratios), model + share * (exact - model))
        return _one(problem.with_exact(values), None)

    return Quantity("times", 1.0, 2.0, 64.0, at)


def _latency(problem: Problem) -> Quantity:
    def at(value: float) -> list[Variant]:
        inputs = {n: problem.dead_time.inputs.get(n, 0.0) + value for n in problem.plant.inputs}
        return _one(replace(problem, dead_time=replace(problem.dead_time, inputs=inputs)), value)

    return Quantity(problem.time_unit, 0.0, problem.period, problem.period * max(problem.cycles // 4, 1), at)


def _sensed(problem: Problem, change: Callable[[Sensor, str, float], Sensor]) -> Callable[[float], list[Variant]]:
    sensing = problem.sensing

    def at(value: float) -> list[Variant]:
        sensors = {n: change(sensing.sensors.get(n, Sensor()), n, value) for n in sensing.measures(problem.plant)}
        return _one(replace(problem, sensing=replace(sensing, sensors={**sensing.sensors, **sensors})), value)

    return at


def _noise(problem: Problem) -> Quantity:
    sizes = ranges(problem)
    change = lambda s, n, v: replace(s, noise=Noise(v * sizes[n])) if n in sizes and v else s  # noqa: E731
    return Quantity("of the range", 0.0, 1e-3, 4.096, _sensed(problem, change))


def _lost(problem: Problem) -> Quantity:
    return Quantity("of the samples", 0.0, 0.02, 0.98, _sensed(problem, lambda s, _, v: replace(s, dropout=v)))


def _plants(problem: Problem) -> Quantity:
    draws = lambda percent: Draws(PLANTS if percent else 1, percent).of_problem(problem)  # noqa: E731
    return Quantity("% around the exact parameters", 0.0, 8.0, 99.0, draws)


QUANTITIES = {"mismatch": _mismatch, "plants": _plants, "latency": _latency, "noise": _noise, "lost": _lost}


@dataclass(frozen=True, eq=False, kw_only=True)
class Limits(Study):
    """The result of `limits`."""

    table: pd.DataFrame  # a row per controller and quantity: unit, holds, fails, why
    fails: float

    @property
    def view(self) -> View:
        shown = Table(
            f"{self.problem}: where controllers fail",
            [Column(c) for c in ("controller", "quantity", "holds", "fails", "why")],
        )
        for row in self.table.itertuples():
            shown.add([row.controller, f"{row.quantity} [{row.unit}]", number(row.holds), number(row.fails), row.why])
        best = self.table.sort_values("fails").groupby("quantity", sort=False).last()
        sentences = [(f"{name}: {row.controller} bears most.", None) for name, row in best.iterrows()]
        about = f"A run fails if it ends early, or has an rms error above {in_percent(self.fails)} of the reference's range."
        return self.viewed(sentences, about, (shown,), {"limits": self.table.to_dict("records"), "fails": self.fails})


@checked_call
def limits(
    task: Task,
    *,
    over: Sequence[str] | None = None,
    controllers: Sequence[str] | None = None,
    fails: float = FAILS,
    compiled: bool = True,
    command: str = "",
    progress: Progress | None = None,
) -> Limits:
    """Return for every controller the mismatch, drawn plants, latency, noise and lost samples at which it fails, to 5 %."""
    begin, chosen, rows = time.perf_counter(), select(task, controllers), []
    check_gains(task, chosen)
    for name in over or ():
        if name not in QUANTITIES:
            raise InvalidName(f"quantity '{name}' is unknown.{nearest(name, QUANTITIES)}")
    ready = replace(task, controllers={n: believing(task.problem, c) for n, c in chosen.items()})
    for name in chosen:
        runner = Runner(ready, name, [m for m in task.metrics if m.name == "rms_error"], compiled=compiled)
        for done, what in enumerate(over or QUANTITIES):
            rows.append({"controller": name, "quantity": what, **_limit(task.problem, what, runner, fails)})
            if progress:
                progress(name, done + 1, len(over or QUANTITIES))
    return Limits(table=pd.DataFrame(rows), fails=fails, **circumstances(task, chosen, command, begin))


def _limit(problem: Problem, what: str, runner: Runner, fails: float) -> Mapping[str, object]:
    try:
        quantity = QUANTITIES[what](problem)
    except FpirhcError as error:
        return {"unit": "", "holds": math.nan, "fails": math.nan, "why": f"not tried: {error}"}
    reasons: dict[float, str] = {}

    def failed(value: float) -> bool:
        if value not in reasons:
            try:
                worst = max(
                    runner.records(quantity.at(value)),
                    key=lambda r: r["error"] if r["error"] == r["error"] else math.inf,
                )
                reasons[value] = worst["why"] or (
                    "" if worst["error"] <= fails else f"error of {in_percent(worst['error'])}"
                )
            except FpirhcError as error:
                reasons[value] = str(error)
        return bool(reasons[value])

    holds, ends = (math.nan, quantity.start) if failed(quantity.start) else bracket(failed, quantity)
    return {"unit": quantity.unit, "holds": holds, "fails": ends, "why": reasons.get(ends, "")}


def bracket(failed: Callable[[float], bool], of: Quantity) -> tuple[float, float]:
    """Return the largest value that holds and the smallest one that fails; infinity where none fails."""
    holds, fails = of.start, of.first
    while not failed(fails):
        if fails >= of.most:
            return fails, math.inf
        holds, fails = fails, min(2 * fails, of.most)
    for _ in range(_HALVINGS):
        if fails <= _NEAR * holds:
            break
        middle = math.sqrt(holds * fails) if holds > 0 else fails / 2
        holds, fails = (holds, middle) if failed(middle) else (middle, fails)
    return holds, fails
