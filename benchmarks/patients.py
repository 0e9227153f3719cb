"""How patients fare over several seeds of the noise: python benchmarks/patients.py [PROBLEM] [--seeds N] [--cases PATTERN ...]

By group and controller: the worst patient's share of the time in the range in %, the lowest value of anybody, the mean share in %,
and how many of all are in the range for less than 90 % of the time. Each is the median of the seeds, with the least and the most.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.problem_files.problem_file import Task

ENOUGH = 0.9  # share of the time
FIGURES = ("worst", "lowest", "mean", "below 90 %")


def of_seed(
    task: Task, patterns: Sequence[str], controllers: Sequence[str], seed: int
) -> dict[tuple[str, str], tuple[float, ...]]:
    """By group and controller, the `FIGURES` with one seed."""
    cases = task.cases
    assert cases is not None
    with tempfile.TemporaryDirectory() as folder:
        study = fp.compare_scenarios(task, cases=patterns, controllers=controllers, seed=seed, folder=Path(folder))
        all_records = {controller: list(records) for controller, records in study.records.items()}
    found = {}
    for controller, records in all_records.items():
        for group in dict.fromkeys(cases.group(r["name"]) for r in records):
            own = [r["metrics"] for r in records if cases.group(r["name"]) == group]
            shares, lowest = (np.array([m[what][""] for m in own]) for what in ("in_band", "lowest"))
            below = float(np.sum(shares < ENOUGH))
            found[group, controller] = (100 * shares.min(), lowest.min(), 100 * shares.mean(), below)
    return found


def of_seeds(
    task: Task, patterns: Sequence[str], controllers: Sequence[str], seeds: int
) -> dict[tuple[str, str], np.ndarray]:
    """The same with seeds 0 to N - 1, shape (N, 4)."""
    runs = [of_seed(task, patterns, controllers, seed) for seed in range(seeds)]
    return {key: np.array([run[key] for run in runs]) for key in runs[0]}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problem", nargs="?", default="anaesthesia_people")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cases", nargs="+", default=["all"])
    chosen = parser.parse_args()
    task = fp.load_problem(chosen.problem)
    table = of_seeds(task, chosen.cases, list(task.controllers), chosen.seeds)
    width = max(len(f"{group}, {controller}") for group, controller in table)
    print(f"{'':{width}s}  {'  '.join(f'{name:>20s}' for name in FIGURES)}")
    for (group, controller), values in table.items():
        cells = (f"{np.median(v):.1f} ({v.min():.1f} to {v.max():.1f})" for v in values.T)
        print(f"{f'{group}, {controller}':{width}s}  {'  '.join(f'{cell:>20s}' for cell in cells)}")


if __name__ == "__main__":
    main()
