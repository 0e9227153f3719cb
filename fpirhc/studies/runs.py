"""Every controller's run in each variant as a row of one table. Rows are kept as they come, so that the same call goes on."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import pandas as pd

from fpirhc.controllers.contract import resolved
from fpirhc.describe import digest
from fpirhc.errors import FpirhcError, InvalidProblem, OutputError, WorkerDied, writing
from fpirhc.problem_files.problem_file import Task, load_problem
from fpirhc.problem_files.settings import current_setting, with_settings
from fpirhc.simulation.metrics import Metric, measure
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.studies import Progress, versions
from fpirhc.studies.compare import select
from fpirhc.studies.variants import Variant, Variants
from fpirhc.studies.verdict import left_alone, ranges, relative
from fpirhc.summary import in_units
from fpirhc.symbolic.evaluate import Latest
from fpirhc.task.cases import as_declared, unit_of_setting
from fpirhc.task.problem import Problem

BLOCK = 64  # runs of a job at most
FEW = 8  # runs, for which no other process is begun
_LOOPS = 64  # that are kept

Row = dict[str, Any]


class Runner:
    """Runs one controller in variants; a loop is built once for all that it serves."""

    def __init__(self, task: Task, name: str, metrics: Sequence[Metric], *, compiled: bool | None) -> None:
        self._task, self._name, self._controller = task, name, task.controllers[name]
        self._metrics, self._compiled = metrics, compiled
        self._loops = Latest[Simulator | FpirhcError](_LOOPS)
        self._ranges, self._held = ranges(task.problem)

    def rows(self, variants: Iterable[Variant]) -> Iterator[Row]:
        """Yield the row of every variant. A setting that the controller does not have leaves it as it is."""
        for one in variants:
            yield self._row(one, self._own(one.settings))

    def _own(self, settings: Mapping[str, float]) -> dict[str, Any]:
        own = {}
        for path, value in settings.items():
            with contextlib.suppress(FpirhcError):
                current_setting(self._controller, path)
                own[path] = as_declared(self._controller, path, value)
        return own

    def _row(self, one: Variant, own: Mapping[str, float]) -> Row:
        row: Row = {"controller": self._name, "variant": one.name, "group": one.group, "seed": one.seed, **one.numbers}
        try:
            loop, live = self._loop(one, own)
            run = loop.run(seed=one.seed, variant=one.problem, settings=own if live and own else None)
        except FpirhcError as error:
            return row | {"outcome": "refused", "error": math.nan, "lasted": 0.0, "why": str(error)}
        return row | self._numbers(one, run)

    def _numbers(self, one: Variant, run: Run) -> Row:
        metrics = measure(one.problem, run, self._metrics)
        errors = metrics.rms_error
        error = math.inf if run.stop else relative(errors, self._ranges)
        outcome = "ended early" if run.stop else "finished" if self._follows(one, errors, error) else "diverged"
        flat = {m.key(element): value for m, element, value in metrics.rows()}
        lasted = run.cycles / one.problem.cycles
        return {"outcome": outcome, "error": error, "lasted": lasted, **flat, "why": run.stop or ""}

    def _follows(self, one: Variant, errors: Mapping[str, float], error: float) -> bool:
        """Whether the error is smaller than the motion; where a reference rests, than that of the plant left alone."""
        if error <= 1 or not self._held or not math.isfinite(error):
            return error <= 1
        alone = left_alone(one.problem, one.seed)
        sizes = {c: max(r, alone.get(c, 0.0)) if c in self._held else r for c, r in self._ranges.items()}
        return relative(errors, sizes) <= 1

    def _loop(self, one: Variant, own: Mapping[str, float]) -> tuple[Simulator, bool]:
        """The loop of a variant, and whether its settings are live in it; where they cannot be it is built with them."""
        for live in (True, False) if own else (True,):
            found = self._built(one, own, live=live)
            if isinstance(found, Simulator):
                return found, live
        assert isinstance(found, FpirhcError)
        raise found

    def _built(self, one: Variant, own: Mapping[str, float], *, live: bool) -> Simulator | FpirhcError:
        key = one.build, tuple(own) if live else tuple(own.items())
        return self._loops.of((), key, lambda: self._composed(one, own, live=live))

    def _composed(self, one: Variant, own: Mapping[str, float], *, live: bool) -> Simulator | FpirhcError:
        base, controller, paths = one.built or one.problem, self._controller, tuple(own) if live else ()
        once = one.alone or not live
        try:
            controller = controller if live else with_settings(controller, own)
            controller = resolved(one.believed, controller) if one.believed else controller
            # A loop that runs once is worth a compiler where the run is long.
            compiled = self._compiled and (None if once and not paths else True)
            return simulator(base, resolved(base, controller), compiled=compiled, live=paths)
        except FpirhcError as error:
            return error


def run_variants(
    task: Task,
    variants: Variants,
    *,
    controllers: Sequence[str] | None = None,
    metrics: Sequence[Metric] | None = None,
    processes: int | None = None,
    compiled: bool | None = True,
    keep: Path | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Run every controller in every variant and return a row for each, in order; its `attrs["units"]` are those of the columns.

    Columns: controller, variant, group, seed, a column for every number that the variants change, by its path, 'exact.m1', outcome
    ('finished', 'diverged' with an error as large as the motion, 'ended early', 'refused'), error (relative to the references'
    ranges), lasted (share of the cycles), a column for every number of a metric, and why a run failed.

    Args:
        controllers: names; None: all.
        metrics: None: those of the task that every run of a study has.
        processes: number of processes, one for a real plant; None: what a `joblib.parallel_config` around the call says, else 1.
            With `joblib.parallel_config(backend="dask")` and a Dask client the runs go to its cluster.
        compiled: whether loops are compiled; those that run once are so where the run is long.
        keep: file of JSON lines; rows that it holds are not run again, and new ones are added as they come.
        progress: called with (controller, done, in all).

    Raises:
        InvalidName: no such controller; the nearest is offered.
        InvalidProblem: more than one process, and the task is not the one of its file.
        OutputError: the file holds rows of another study, or cannot be written.
        WorkerDied: a process was killed.
    """
    chosen = replace(task, controllers=select(task, controllers))
    metrics = [one for one in task.metrics if one.always] if metrics is None else metrics
    every = variants.of(chosen)
    if task.problem.moves.rest is not None:
        processes = 1  # a real plant would have two loops that command it
    with Kept(keep, header_of(chosen, variants.same, metrics)) as kept:
        titles = {one: k for k, one in enumerate(one.name for one in every)}
        rows = {(r["controller"], r["variant"]): r for r in kept.rows}
        counts = {n: sum((n, title) in rows for title in titles) for n in chosen.controllers}
        jobs = _jobs(rows, titles, chosen.controllers, joblib.effective_n_jobs(processes))
        for row in _answers(task, variants, jobs, processes, (metrics, compiled), every):
            kept.append(row)
            name = row["controller"]
            rows[name, row["variant"]], counts[name] = row, counts[name] + 1
            if progress:
                progress(name, counts[name], len(every))
    frame = pd.DataFrame([rows[n, title] for n in chosen.controllers for title in titles])
    return in_units(frame, _units(task.problem, metrics, frame))


def _jobs(
    rows: Mapping[tuple[str, str], Row], titles: Mapping[str, int], names: Mapping[str, object], workers: int
) -> list[tuple[str, tuple[int, ...]]]:
    """What is to run: controllers take turns, so that processes begin with different loops."""
    lacking = {n: [k for title, k in titles.items() if (n, title) not in rows] for n in names}
    size = max(1, min(BLOCK, -(-max(map(len, lacking.values())) // (2 * workers))))
    blocks = {n: [tuple(todo[at : at + size]) for at in range(0, len(todo), size)] for n, todo in lacking.items()}
    if workers == 1:
        return [(n, block) for n, some in blocks.items() for block in some]
    most = max(map(len, blocks.values()))
    return [(n, some[k]) for k in range(most) for n, some in blocks.items() if k < len(some)]


def _answers(
    task: Task,
    variants: Variants,
    jobs: Sequence[tuple[str, tuple[int, ...]]],
    processes: int | None,
    how: tuple[Sequence[Metric], bool | None],
    every: Sequence[Variant],
) -> Iterator[Row]:
    metrics, compiled = how
    if joblib.effective_n_jobs(processes) == 1 or sum(len(some) for _, some in jobs) <= FEW:
        for name in dict.fromkeys(name for name, _ in jobs):
            own = [k for n, some in jobs if n == name for k in some]
            yield from Runner(task, name, metrics, compiled=compiled).rows(every[k] for k in own)
        return
    path, told, names = str(task.path.resolve()), _told(task), {one.name for one in metrics}
    _require_same(load_problem(path), told)
    work = joblib.Parallel(n_jobs=processes, return_as="generator_unordered", batch_size=1)
    killed = getattr(sys.modules.get("distributed.scheduler"), "KilledWorker", BrokenProcessPool)  # where Dask is used
    answers = work(joblib.delayed(_remote)(path, told, variants, n, some, compiled, names) for n, some in jobs)
    try:
        for rows in answers:
            yield from rows
    except (BrokenProcessPool, killed) as error:
        raise WorkerDied(
            "a process of the study was killed, perhaps for want of memory; finished runs are kept: the same call goes on with the "
            f"others ({type(error).__name__})"
        ) from None
    finally:
        with contextlib.suppress(Exception):
            answers.close()


def _told(task: Task) -> str:
    return digest(task.problem, task.controllers, [m.name for m in task.metrics])


def _require_same(task: Task, told: str) -> None:
    if _told(task) != told:
        raise InvalidProblem(
            f"problem '{task.name}' is not that of '{task.path}', which other processes load; write the changes into the file, or "
            "use one process"
        )


_OWN = threading.local()  # a worker of Dask has threads, and a loop serves one


def _remote(
    path: str, told: str, variants: Variants, name: str, some: Sequence[int], compiled: bool | None, names: set[str]
) -> list[Row]:
    """The rows of some variants, in a process that keeps the loops of one study."""
    with contextlib.suppress(ValueError):  # a thread
        # Ctrl-C of a terminal reaches every process, and the first one ends the others.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    study = told, repr(variants), compiled, names
    if getattr(_OWN, "study", None) != study:
        task = load_problem(path)
        _require_same(task, told)
        _OWN.study, _OWN.task, _OWN.every, _OWN.runners = study, task, variants.of(task), {}
    if name not in _OWN.runners:
        metrics = [one for one in _OWN.task.metrics if one.name in names]
        _OWN.runners[name] = Runner(_OWN.task, name, metrics, compiled=compiled)
    return list(_OWN.runners[name].rows([_OWN.every[k] for k in some]))


def _units(problem: Problem, metrics: Sequence[Metric], frame: pd.DataFrame) -> dict[str, str]:
    units = {}
    for column in map(str, frame):
        for metric in metrics:
            element = column.removeprefix(metric.name).removeprefix(".")
            if column == metric.key(element):
                units[column] = metric.unit_of(problem, element)
        with contextlib.suppress(FpirhcError, KeyError):
            units.setdefault(column, unit_of_setting(column, problem))
    return units


def header_of(task: Task, study: Mapping[str, object], metrics: Sequence[Metric]) -> dict[str, object]:
    """Return what rows of a study depend on, beside what they say themselves."""
    content = hashlib.sha256(task.path.read_bytes()).hexdigest()[:16] if task.path.is_file() else ""
    facts = {"file": content, "problem": digest(task.problem), "metrics": [m.name for m in metrics], **versions()}
    return {**study, **facts, **{f"controller '{n}'": digest(c) for n, c in task.controllers.items()}}


class Kept:
    """Rows in a file of JSON lines behind a header; without a path nothing is kept."""

    def __init__(self, path: Path | None, header: Mapping[str, object]) -> None:
        self.rows: list[Row] = []
        self._path, self._file = path, None
        if path is None:
            return
        first, lines = json.loads(json.dumps(header, default=str)), []
        with writing(self._path, "--out"):
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                lines = path.read_text(encoding="utf-8").split("\n")[:-1]  # a torn last line is run again
        try:
            head, *self.rows = map(json.loads, lines) if lines else (first,)
            other = {key for key in first if key in head and head[key] != first[key]}
        except (ValueError, TypeError, AttributeError):
            raise OutputError(f"'{path}' holds no rows of a study; give another --out, or remove it") from None
        if other:
            said = ", ".join(f"{key} was {head[key]}, is {first[key]}" for key in first if key in other)
            raise OutputError(f"'{path}' holds rows of another study ({said}); give another --out, or remove the file")
        with writing(self._path, "--out"):
            path.write_text("".join(f"{line}\n" for line in (json.dumps(head | first), *lines[1:])), encoding="utf-8")
            self._file = path.open("a", encoding="utf-8")

    def append(self, row: Row) -> None:
        """Add a row."""
        if self._file is not None:
            with writing(self._path, "--out"):
                self._file.write(json.dumps(row) + "\n")
                self._file.flush()

    def __enter__(self) -> Kept:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
