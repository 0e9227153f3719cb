"""What a record of a scenario costs, and how much faster scenarios run in two processes: whole commands, from start to report.

    python benchmarks/scenarios.py [--write] [--records] [--memory]     --write puts the tables into docs/performance.md
                                                                        --records measures records alone, in seconds
                                                                        --memory measures large studies alone, in minutes

A record is one run of one controller in one scenario, with its metrics: processor time, the smallest of many, of single runs and of
runs side by side; bytes of memory are those of a thousand more records that are read from a file. The memory of a study is the
largest one that a command holds, in a process of its own.

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
from pathlib import Path
from typing import Any

import numpy as np

import fpirhc as fp
from fpirhc.studies.scenarios.bench import Bench, Conditions
from fpirhc.studies.scenarios.draws import COMPARING
from fpirhc.studies.scenarios.ledger import Ledger

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

ROUNDS = 3
RECORDS = 25  # that are timed
SOME, MORE = 40, 80  # times that they are read in the smaller and the larger file
TURNS, BLOCK = 4, 64  # of scenarios side by side; the first one compiles
LARGE = "fishery", ("CTC", "CTC+FPI"), (1_000, 10_000, 100_000)  # studies whose memory is measured
STUDIES = (
    ("two_mass", ("CTC", "CTC+FPI (eq 6)"), 20_000),
    ("van_der_pol", ("RHC", "RHC+FPI", "RHC exact model"), 6000),
)


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


def record(name: str, controller: str) -> tuple[str, ...]:
    """One row: what a record costs."""
    task = fp.load_problem(name)
    bench = Bench(task, Conditions(seed=0, use=COMPARING, percent=10.0, compiled=True))
    made, taken = [bench.record(0, controller)], []
    for number in range(1, RECORDS):
        begin = time.process_time()
        made.append(bench.record(number, controller))
        taken.append(time.process_time() - begin)
    lanes, together = Bench(task, Conditions(seed=0, use=COMPARING, percent=10.0, compiled=True, side_by_side=True)), []
    for turn in range(TURNS):
        begin = time.process_time()
        some = list(lanes.records(range(turn * BLOCK, (turn + 1) * BLOCK), controller))
        together.append((time.process_time() - begin) / len(some))
    memory = [held([{**one, "scenario": k} for k, one in enumerate(made * times)]) for times in (SOME, MORE)]
    lines = [len(json.dumps(one, separators=(",", ":"))) for one in made]
    return (
        f"{name}: {controller}, {task.problem.cycles} cycles",
        f"{1e3 * min(taken):.1f}",
        f"{1e3 * min(together):.2f}",
        f"{min(taken) / min(together):.1f}",
        f"{(memory[1] - memory[0]) / (RECORDS * (MORE - SOME)):.0f}",
        f"{np.mean(lines):.0f}",
    )


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
    heads = ("a record", "ms", "ms side by side", "times faster", "bytes of memory", "bytes in the file")
    write_table("records", heads, [record(name, one) for name, names, _ in STUDIES for one in names[:2]])
    if "--records" in sys.argv:
        return
    rows = []
    for name, controllers, count in STUDIES:
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
