"""What a record of a scenario costs, and how much faster scenarios run in two processes: whole commands, from start to report.

    python benchmarks/scenarios.py [--write] [--records] [--memory] [--tables] [--commands]

--write puts the tables into docs/performance.md. --records measures records alone, in seconds; --memory large studies, in minutes;
--tables the files of a large study; --commands whole commands.

A record is one run of one controller in one scenario, with its metrics: processor time, the smallest of many, of single runs and of
runs side by side, in rounds in which all rows take turns, so that other work falls on all of them. Bytes of memory are those of a
thousand more records that are read from a file. The memory of a study is the largest one that a command holds, in a process of its
own.

Libraries are compiled before anything is timed. In every round the five ways take turns, so that whatever else the machine does
falls on all: one process on one core; on both cores one process, two processes, two workers of a local Dask cluster, and, for what
the machine can give, the same work cut in halves by hand and run as two commands at once. Ratios are those of the medians.
CPU seconds show what sharing itself costs, also on a machine with other work.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import fpirhc as fp
from fpirhc.cli.output import table_writer
from fpirhc.studies.scenarios import scenario_study
from fpirhc.studies.scenarios.bench import Bench, Conditions
from fpirhc.studies.scenarios.draws import COMPARING
from fpirhc.studies.scenarios.ledger import Ledger
from fpirhc.studies.scenarios.parquet import FOLDER, ParquetFolder

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

ROUNDS = 1  # a median of several takes a quarter of an hour
RECORDS = 25  # that are timed, in as many rounds
SOME, MORE = 40, 80  # times that they are read in the smaller and the larger file
BLOCK = 64  # scenarios side by side
LARGE = "fishery", ("CTC", "CTC+FPI"), (1_000, 10_000, 100_000)  # studies whose memory is measured
STUDIES = (("two_mass", ("CTC", "CTC+FPI (eq 6)"), 6000), ("van_der_pol", ("RHC", "RHC+FPI", "RHC exact model"), 6000))


def command(
    name: str, controllers: tuple[str, ...], count: int, processes: int, folder: Path, *more: str, seed: int = 0
) -> list[str]:
    return [
        *(
            sys.executable,
            "-m",
            "fpirhc",
            "compare",
            name,
            "--scenarios",
            f"{count}",
            "--mismatch",
            "10",
            "--seed",
            f"{seed}",
        ),
        *("--processes", f"{processes}", "--out", str(folder), *more, "--controllers", *controllers),
    ]


def measured(*commands: list[str], cores: int | None = None) -> tuple[float, float]:
    """Wall and CPU seconds of commands that run at once, on so many cores."""
    used, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(own)[:cores])
    running = [subprocess.Popen(c, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for c in commands]
    os.sched_setaffinity(0, own)
    assert [process.wait() for process in running] == [0] * len(commands)
    wall, now = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime


def study(name: str, controllers: tuple[str, ...], count: int) -> tuple[str, ...]:
    """One row: medians over the rounds."""
    taken: dict[str, list[tuple[float, float]]] = {way: [] for way in ("core", "one", "two", "dask", "halves")}
    for _ in range(ROUNDS):
        with tempfile.TemporaryDirectory() as base:
            folders = [Path(base) / f"{k}" for k in range(6)]
            taken["core"].append(measured(command(name, controllers, count, 1, folders[5]), cores=1))
            taken["one"].append(measured(command(name, controllers, count, 1, folders[0])))
            taken["two"].append(measured(command(name, controllers, count, 2, folders[1])))
            dask = command(name, controllers, count, 2, folders[4], "--cluster", "local")
            taken["dask"].append(measured(dask))
            halves = [command(name, controllers, count // 2, 1, folders[k + 2], seed=k) for k in (0, 1)]
            taken["halves"].append(measured(*halves))
            written = (*folders[:2], *folders[4:])
            ledgers = [sorted((f / "scenarios.jsonl").read_text().splitlines()) for f in written]
            assert all(one == ledgers[0] for one in ledgers), "results depend on who computes them"
    wall = {way: float(np.median([w for w, _ in times])) for way, times in taken.items()}
    cpu = {way: float(np.median([c for _, c in times])) for way, times in taken.items()}
    others = ("one", "two", "dask", "halves")
    return (
        f"{name}: {', '.join(controllers)}",
        f"{count * len(controllers)}",
        f"{wall['core']:.1f}",
        *(f"{wall['core'] / wall[way]:.2f}" for way in others),
        f"{wall['halves'] / wall['dask']:.2f}",
        *(f"{cpu[way]:.1f}" for way in ("core", *others)),
    )


def memory(name: str, controllers: tuple[str, ...], count: int) -> tuple[str, ...]:
    """One row: what a whole study holds, and what it takes."""
    with tempfile.TemporaryDirectory() as folder:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        child = subprocess.Popen(command(name, controllers, count, 1, Path(folder)), stdout=subprocess.DEVNULL)
        _, status, own = os.wait4(child.pid, 0)
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        child.returncode = os.waitstatus_to_exitcode(status)
        assert child.returncode == 0
    seconds = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    rows = count * len(controllers)
    return (
        f"{name}: {', '.join(controllers)}",
        f"{count}",
        f"{own.ru_maxrss / 1024:.0f}",
        f"{1e3 * seconds / rows:.2f}",
        f"{seconds:.0f}",
    )


class TimedFolder(ParquetFolder):
    """It knows the processor time of its rows."""

    seconds = 0.0

    def add(self, record: Mapping[str, Any]) -> None:
        begin = time.process_time()
        super().add(record)
        TimedFolder.seconds += time.process_time() - begin

    def __exit__(self, *error: object) -> None:
        begin = time.process_time()
        super().__exit__(*error)
        TimedFolder.seconds += time.process_time() - begin


def size(path: Path) -> int:
    """Bytes of a file, or of those in a folder."""
    return sum(one.stat().st_size for one in ([path] if path.is_file() else path.iterdir()))


def tables(name: str, controllers: tuple[str, ...], counts: tuple[int, ...]) -> list[tuple[str, ...]]:
    """What the records of a study take in every kind of file."""
    with tempfile.TemporaryDirectory() as base:
        folder = Path(base)
        task, count = fp.load_problem(name), counts[-1] // len(controllers)
        rows, begin, scenario_study.ParquetFolder = count * len(controllers), time.process_time(), TimedFolder
        wanted: dict[str, Any] = {"controllers": controllers, "count": count, "percent": 10.0, "seed": 0}
        found = fp.compare_scenarios(task, **wanted, folder=folder, parquet=True)
        taken = TimedFolder.seconds
        seconds = {"jsonl": time.process_time() - begin - taken, "parquet": taken}
        begin = time.process_time()
        table_writer("csv")(found.frames(), folder / "scenarios")
        seconds["csv"] = time.process_time() - begin
        begin = time.process_time()
        pd.read_parquet(folder / FOLDER)
        read = time.process_time() - begin
        words = {"jsonl": "the ledger, with its runs", "csv": "`--format csv`", "parquet": "`--format parquet`"}
        sizes = {form: size(folder / f"scenarios.{form}") / rows for form in words}
    return [
        (words[f], f"{rows}", f"{sizes[f]:.0f}", f"{seconds[f]:.1f}", f"{read:.2f}" if f == "parquet" else "")
        for f in words
    ]


class Records:
    """One row: what a record costs, in rounds."""

    def __init__(self, name: str, controller: str) -> None:
        task = fp.load_problem(name)
        self._name, self._controller = f"{name}: {controller}, {task.problem.cycles} cycles", controller
        conditions = Conditions(seed=0, use=COMPARING, percent=10.0, compiled=True)
        self._alone, self._together = Bench(task, conditions), Bench(task, replace(conditions, side_by_side=True))
        self._made: list[dict[str, Any]] = []
        self._taken: list[tuple[float, float]] = []  # alone and side by side, s

    def round(self, number: int) -> None:
        """Time one record alone, and some side by side."""
        begin = time.process_time()
        self._made.append(self._alone.record(number, self._controller))
        between = time.process_time()
        some = list(self._together.records(range(number * BLOCK, (number + 1) * BLOCK), self._controller))
        self._taken.append((between - begin, (time.process_time() - between) / len(some)))

    @property
    def row(self) -> tuple[str, ...]:
        """Its cells; the first round compiles."""
        alone, together = np.min(self._taken[1:], axis=0)
        some = [held([{**one, "scenario": k} for k, one in enumerate(self._made * times)]) for times in (SOME, MORE)]
        return (
            self._name,
            f"{1e3 * alone:.1f}",
            f"{1e3 * together:.2f}",
            f"{alone / together:.1f}",
            f"{(some[1] - some[0]) / (len(self._made) * (MORE - SOME)):.0f}",
            f"{np.mean([len(json.dumps(one, separators=(',', ':'))) for one in self._made]):.0f}",
        )


def records() -> list[tuple[str, ...]]:
    """Every row."""
    some = [Records(name, one) for name, names, _ in STUDIES for one in names[:2]]
    for number in range(RECORDS):
        for one in some:
            one.round(number)
    return [one.row for one in some]


def held(records: list[dict[str, Any]]) -> int:
    """Bytes of memory of records that are read from a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenarios.jsonl"
        with Ledger(path, {}) as ledger:
            for one in records:
                ledger.append(one)
        tracemalloc.start()
        with Ledger(path, {}) as ledger:
            assert len(ledger.records) == len(records)
            size, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    return size


def main() -> None:
    """Measure and print."""
    if "--memory" in sys.argv:
        heads_of_studies = (
            "a study",
            "scenarios",
            "largest memory, MB",
            "ms of processor time a record",
            "s of processor time",
        )
        name, controllers, counts = LARGE
        write_table("study memory", heads_of_studies, [memory(name, controllers, count) for count in counts])
        return
    if "--tables" in sys.argv:
        heads_of_files = ("file", "records", "bytes a record", "s to write", "s to read")
        write_table("study files", heads_of_files, tables(*LARGE))
        return
    heads = ("a record", "ms", "ms side by side", "times faster", "bytes of memory", "bytes in the file")
    if "--commands" not in sys.argv:
        write_table("records", heads, records())
    if "--records" in sys.argv:
        return
    rows = []
    for name, controllers, count in STUDIES[:1]:
        with tempfile.TemporaryDirectory() as folder:
            measured(command(name, controllers, 1, 1, Path(folder)))  # compiles
        rows.append(study(name, controllers, count))
    ways = ("one process on both", "two processes", "two Dask workers", "halves by hand")
    heads_of_commands = (
        *("problem", "runs", "s, one process on one core", *(f"{way}: times faster" for way in ways)),
        "Dask's share of halves",
        *(f"CPU s, {way}" for way in ("one process on one core", *ways)),
    )
    write_table("scenarios", heads_of_commands, rows)


if __name__ == "__main__":
    main()
