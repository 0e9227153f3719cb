"""Variants of a problem, and every controller's run in each of them as one table.

A variant is the problem with other numbers: a named case, a plant drawn at random, a cell of a grid. Whatever it is, its run is one
row of a pandas DataFrame, and every study is such a table with something said of it.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pandas as pd

from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import resolved
from fpirhc.describe import digest
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, OutputError
from fpirhc.plant.plant import drawn, exact_ranges
from fpirhc.problem_files.problem_file import Task, load_problem
from fpirhc.problem_files.settings import current_setting, of_problem, with_numbers, with_settings
from fpirhc.simulation.metrics.base import Metric, Metrics, measure
from fpirhc.simulation.simulate import ComposedLoop, Simulator
from fpirhc.studies.view import Progress, versions
from fpirhc.task.problem import Problem

BLOCK = 64  # runs of a job
_SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Variant:
    """One variant of a problem."""

    name: str
    problem: Problem
    build: object = None  # variants with equal ones have one loop: their problems differ in exact parameters alone
    settings: Mapping[str, float] = field(default_factory=dict)  # of controllers, by path
    seed: int = 0  # of the noise
    group: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)  # what the table says of it, by path


class Variants(ABC):
    """The variants of a study: plain data, from which every process makes the same ones."""

    seed: int

    @abstractmethod
    def of(self, task: Task) -> Sequence[Variant]:
        """Return the variants of a task."""


@dataclass(frozen=True)
class CasesOf(Variants):
    """The cases of the problem file with these names, of cases or of groups."""

    names: tuple[str, ...] = ("all",)
    seed: int = 0

    def of(self, task: Task) -> Sequence[Variant]:
        cases = task.cases
        if cases is None:
            raise InvalidValue(f"problem '{task.name}' has no cases; add cases = fpirhc.Cases(...) to its file")
        made, variants = dict[object, Problem](), []
        for name in cases.matching(self.names):
            key, place = cases.key(name), cases.names.index(name)
            if key not in made:
                made[key] = cases.build(name, task.problem)
            own = cases.seed(name)
            seed = _noise(self.seed, place) if own is None else own
            variants.append(Variant(name, cases.exactly(name, made[key]), key, seed=seed, group=cases.group(name)))
        return variants


@dataclass(frozen=True)
class Draws(Variants):
    """Plants drawn at random: exact parameters and dead times within `percent` of the problem's, the same for every controller."""

    count: int
    percent: float = 0.0
    seed: int = 0

    def of(self, task: Task) -> Sequence[Variant]:
        return self.of_problem(task.problem)

    def of_problem(self, problem: Problem) -> Sequence[Variant]:
        """Return the variants of a problem."""
        exact_ranges(problem.moved, self.percent)
        return _Lazy(self.count, lru_cache(4096)(lambda k: self._one(problem, k)))

    def _one(self, problem: Problem, number: int) -> Variant:
        parameters = problem.moved.parameters
        random = np.random.default_rng([self.seed, number])
        shares, late = random.random(len(parameters)), int(random.integers(-1, 2))
        exact = np.array([drawn(p, self.percent, float(s)) for p, s in zip(parameters.values(), shares, strict=True)])
        built = _late(problem, late * self.percent)
        return Variant(
            str(number), built.with_exact(exact), late if self.percent else 0, seed=_noise(self.seed, number)
        )


@dataclass(frozen=True)
class Grid(Variants):
    """Every combination of values of some settings, of controllers or of the problem, by path."""

    axes: Mapping[str, tuple[float, ...]]
    seed: int = 0

    def of(self, task: Task) -> Sequence[Variant]:
        paths = {path: of_problem(task.problem, path) for path in self.axes}
        made, variants = dict[object, Problem](), []
        for values in itertools.product(*self.axes.values()):
            numbers = dict(zip(self.axes, values, strict=True))
            ours = {own: numbers[path] for path, own in paths.items() if own}
            key = tuple(sorted(ours.items()))
            if key not in made:
                made[key] = with_numbers(task.problem, ours)
            name = ", ".join(f"{path} = {value:g}" for path, value in numbers.items())
            settings = {path: value for path, value in numbers.items() if paths[path] is None}
            build = tuple(item for item in key if not item[0].startswith("exact."))
            variants.append(Variant(name, made[key], build, settings, self.seed, numbers=numbers))
        return variants

    @staticmethod
    def parsed(texts: Sequence[str], seed: int = 0) -> Grid:
        """Return the grid of texts such as 'deformation.gain=-2:-0.1:40' or 'exact.m1=0.5:2:9:log'."""
        axes = {}
        for text in texts:
            path, _, span = text.partition("=")
            try:
                low, high, count, *log = span.split(":")
                values = (np.geomspace if log == ["log"] else np.linspace)(float(low), float(high), int(count))
            except ValueError:
                raise InvalidValue(f"--over {text}: expected PATH=LOW:HIGH:COUNT or PATH=LOW:HIGH:COUNT:log") from None
            axes[path] = tuple(float(f"{v:.10g}") for v in values)
        return Grid(axes, seed)


class _Lazy(Sequence[Variant]):
    """Variants that are made when they are asked for."""

    def __init__(self, count: int, make: Any) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: Any) -> Any:
        if isinstance(k, slice):
            return [self._make(i) for i in range(*k.indices(self._count))]
        return self._make(range(self._count)[int(k)])


def _noise(seed: int, number: int) -> int:
    return int(np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0])


def _late(problem: Problem, percent: float) -> Problem:
    """The problem with dead times that are longer by so many percent, in whole cycles away from the true one."""
    times, whole = problem.dead_time, math.ceil if percent > 0 else math.floor
    if not percent or not (times.measurement or any(times.inputs.values())):
        return problem

    def changed(time: float) -> float:
        return max(whole(time / problem.period * (1 + percent / 100)), 0) * problem.period

    inputs = {name: changed(time) for name, time in times.inputs.items()}
    return replace(problem, dead_time=replace(times, inputs=inputs, measurement=changed(times.measurement)))


# --- Runs ----------------------------------------------------------------------------------------------------------------


class Runner:
    """Runs one controller in variants; a loop is built once for all that it serves."""

    def __init__(self, task: Task, name: str, metrics: Sequence[Metric], *, compiled: bool | None) -> None:
        self._task, self._name, self._metrics, self._compiled = task, name, metrics, compiled
        self._loops, self._codes, self._ranges = {}, {}, ranges(task.problem)

    def records(self, variants: Sequence[Variant]) -> Iterator[dict[str, Any]]:
        """Yield the row of every variant."""
        yield from (self._alone(replace(one, settings=self._own(one))) for one in variants)

    def _own(self, one: Variant) -> dict[str, float]:
        """The settings that this controller has; without one it is the same along it."""
        own = {}
        for path, value in one.settings.items():
            with contextlib.suppress(FpirhcError):
                current_setting(self._task.controllers[self._name], path)
                own[path] = value
        return own

    def _alone(self, one: Variant) -> dict[str, Any]:
        try:
            loop, live = self._loop(one)
            run = loop.run(
                seed=one.seed, variant=one.problem, settings=dict(one.settings) if live and one.settings else None
            )
        except FpirhcError as error:
            return self._row(one, "refused", math.nan, {}, str(error))
        return self._of_metrics(one, measure(one.problem, run, self._metrics), run.stop or "")

    def _of_metrics(self, one: Variant, metrics: Metrics, stop: str = "") -> dict[str, Any]:
        shares = [rms / self._ranges[c] for c, rms in metrics.rms_error.items()]
        error = math.hypot(*shares) / math.sqrt(len(shares)) if not stop else math.inf
        outcome = "ended early" if stop else "finished" if error <= 1 else "diverged"
        flat = {f"{m}.{e}" if e else m: v for m, some in metrics.values.items() for e, v in some.items()}
        return self._row(one, outcome, error, flat, stop)

    def _row(self, one: Variant, outcome: str, error: float, metrics: Mapping[str, float], why: str) -> dict[str, Any]:
        facts = {"controller": self._name, "variant": one.name, "group": one.group, "seed": one.seed, **one.numbers}
        return {**facts, "outcome": outcome, "error": error, **metrics, "why": why}

    def _loop(self, one: Variant) -> tuple[Simulator, bool]:
        """The loop of a variant, and whether its settings are live in it."""
        controller, own = self._task.controllers[self._name], dict(one.settings)
        base = one.problem.with_exact(self._task.problem.real_parameters)  # a gain is judged by the problem's own plant
        for live, key in ((True, (one.build, tuple(own))), (False, (one.build, tuple(own.items())))):
            if key not in self._loops:
                try:
                    ready = controller if live else with_settings(controller, own)
                    checked(base, ready) if not own else None
                    loop = ComposedLoop.of(base, resolved(base, ready), tuple(own) if live else ())
                    once = self._compiled is None and own and not live  # a loop of one trial is not worth a compiler
                    self._loops[key] = loop.simulator(False if once else self._compiled, known=self._codes)
                except FpirhcError as error:
                    self._loops[key] = error
            if isinstance(self._loops[key], Simulator):
                return self._loops[key], live
        raise self._loops[key]


def ranges(problem: Problem) -> dict[str, float]:
    """Return the range of the reference of every judged coordinate, its start included; 1 where there is none."""
    times, plant = np.linspace(0.0, problem.duration, _SAMPLES), problem.plant
    states = np.asarray(problem.reference.function(plant).map(_SAMPLES)(times[None, :])[0].full())
    places = [plant.output.elements.index(c) for c in problem.judged_names]
    sizes = np.maximum(np.ptp(states[places], axis=1), np.abs(states[places, 0] - problem.start_output[places]))
    return {c: float(s) if s > 0 else 1.0 for c, s in zip(problem.judged_names, sizes, strict=True)}


def run_variants(
    task: Task,
    variants: Variants,
    *,
    controllers: Sequence[str] | None = None,
    metrics: Sequence[Metric] | None = None,
    processes: int = 1,
    compiled: bool | None = True,
    keep: Path | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Run every controller in every variant and return a row for each; rows that the file `keep` holds are not run again.

    With a Dask client of the caller's, `joblib.parallel_config(backend="dask")` around this call sends the jobs to its cluster.

    Raises:
        OutputError: the file holds rows of something else.
    """
    names = list(controllers or task.controllers)
    for name in set(names) - {*task.controllers}:
        raise InvalidName(f"problem '{task.name}' has no controller '{name}'")
    rows, append = _kept(keep, {"study": repr(variants), "task": digest(task.problem, task.controllers), **versions()})
    every = variants.of(task)
    done = {(row["controller"], row["variant"]) for row in rows}
    titles = [one.name for one in every]
    lacking = {n: [k for k, title in enumerate(titles) if (n, title) not in done] for n in names}
    jobs = [(n, todo[at : at + BLOCK]) for n, todo in lacking.items() for at in range(0, len(todo), BLOCK)]
    work = joblib.Parallel(n_jobs=processes, return_as="generator_unordered", batch_size=1)
    if processes == 1:
        answers = (_answer(task, variants, n, tuple(some), metrics, compiled, every) for n, some in jobs)
    else:
        answers = work(
            joblib.delayed(_remote)(str(task.path), variants, n, tuple(some), metrics, compiled) for n, some in jobs
        )
    counts = {n: len(every) - len(todo) for n, todo in lacking.items()}
    for new in answers:
        rows += new
        append(new)
        counts[new[0]["controller"]] += len(new)
        if progress:
            progress(new[0]["controller"], counts[new[0]["controller"]], len(every))
    order = {name: k for k, name in enumerate(names)}
    wanted = {*titles}
    frame = pd.DataFrame([r for r in rows if r["controller"] in order and r["variant"] in wanted])
    return frame.sort_values("controller", key=lambda c: c.map(order), kind="stable", ignore_index=True)


_RUNNERS: dict[Any, tuple[Runner, Sequence[Variant]]] = {}


def _answer(
    task: Task,
    variants: Variants,
    name: str,
    some: Sequence[int],
    metrics: Any,
    compiled: bool | None,
    every: Sequence[Variant] | None = None,
) -> list[dict[str, Any]]:
    key = id(task), repr(variants), name, compiled
    if key not in _RUNNERS:
        _RUNNERS.clear()
        _RUNNERS[key] = Runner(task, name, metrics or task.metrics, compiled=compiled), every or variants.of(task)
    runner, every = _RUNNERS[key]
    return list(runner.records([every[k] for k in some]))


_load = lru_cache(maxsize=1)(load_problem)


def _remote(path: str, *job: Any) -> list[dict[str, Any]]:
    return _answer(_load(path), *job)


def _kept(path: Path | None, header: Mapping[str, Any]) -> tuple[list[dict[str, Any]], Any]:
    """Rows of an earlier, interrupted study in a file of JSON lines, and a function that appends some."""
    if path is None:
        return [], lambda _: None
    path.parent.mkdir(parents=True, exist_ok=True)
    first = json.dumps(header, default=str)
    whole = path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []  # a torn last line is run again
    if whole and whole[0] != first:
        raise OutputError(
            f"'{path}' holds results of something else; give another folder with --out, or remove the file"
        )
    path.write_text("".join(f"{line}\n" for line in whole or [first]), encoding="utf-8")

    def append(rows: Sequence[Mapping[str, Any]]) -> None:
        with path.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)

    return [json.loads(line) for line in whole[1:]], append
