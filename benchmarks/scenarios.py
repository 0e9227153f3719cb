"""How much faster scenarios run in two processes, with everything that a study does: start, load, run, write to disk.

    python benchmarks/scenarios.py [--write]          --write puts the table into docs/performance.md

Libraries are compiled before anything is timed. One and two processes take turns, so that whatever else the machine does
falls on both; the ratio is that of the medians.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import fpirhc as fp

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

ROUNDS = 3
STUDIES = (
    ("two_mass", ("CTC", "CTC+FPI (eq 6)"), 2000),
    ("two_mass", ("RHC", "RHC+FPI"), 500),
    ("van_der_pol", ("RHC", "RHC+FPI", "RHC exact model"), 500),
)


def seconds(task, controllers: tuple[str, ...], count: int, processes: int) -> tuple[float, dict]:
    """Wall time of a whole study in an empty folder, and its records."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        found = fp.compare_scenarios(
            task, count=count, percent=10.0, seed=0, folder=Path(folder), controllers=controllers, processes=processes
        )
        return time.perf_counter() - begin, dict(found.records)


def main() -> None:
    """Measure and print."""
    rows = []
    for name, controllers, count in STUDIES:
        task = fp.load_problem(name)
        seconds(task, controllers, 1, 1)  # compiles
        taken = {1: [], 2: []}
        for _ in range(ROUNDS):
            (one, alone), (two, shared) = (seconds(task, controllers, count, processes) for processes in (1, 2))
            assert alone == shared, "results depend on the number of processes"
            taken[1].append(one)
            taken[2].append(two)
        one, two = (float(np.median(taken[k])) for k in (1, 2))
        runs = count * len(controllers)
        rows.append(
            (
                name,
                ", ".join(controllers),
                f"{runs}",
                f"{one:.1f}",
                f"{two:.1f}",
                f"{one / two:.2f}",
                f"{1e3 * one / runs:.1f}",
            )
        )
    heads = (
        "problem",
        "controllers",
        "runs",
        "s, one process",
        "s, two processes",
        "times faster",
        "ms per run, one process",
    )
    write_table("scenarios", heads, rows)


if __name__ == "__main__":
    main()
