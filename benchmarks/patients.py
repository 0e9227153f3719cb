"""How patients fare over several seeds of the noise: python benchmarks/patients.py [PROBLEM] [--seeds N] [--cases PATTERN ...]

By group and controller: the worst patient's share of the time in the range in %, the lowest value of anybody, the mean share in %,
and how many of all are in the range for less than 90 % of the time. Each is the median of the seeds, with the least and the most.

With --reasons: whom no controller can serve, because the largest target from the beginning takes too long, and how all fare with
one seed where one thing of theirs is as the controllers believe it.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.problem_files.problem_file import Task

ENOUGH = 0.9  # share of the time
FIGURES = ("worst", "lowest", "mean", "below 90 %")
LATEST = 15.0  # min, until which the range must be reached to be in it for 90 % of the time from 10 to 60 min
NOISELESS = "no noise"
BELIEVED: dict[str, dict[str, float]] = {  # what a case has, as the controllers believe it
    "as they are": {},
    NOISELESS: {},
    "dead time": {"dead_time.inputs.target": 0.65},
    "effect site": {"exact.ke0": 0.309},
    "kinetics": {"exact.eleveld": 0.0}
    | {f"exact.times_{n}": 1.0 for n in ("V1", "V2", "V3", "cleared", "fast", "slow")},
    "curve": {
        "exact.E0": 92.0,
        "exact.Emax": 92.0,
        "exact.C50": 4.53,
        "exact.steepness": 1.57,
        "exact.times_above": 1.0,
    },
}


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


def first_below(problem: fp.Problem, run: fp.Run) -> float:
    """When the range is first reached, min; the whole duration where it never is."""
    reached = run.time[run["plant_state.bis"] <= 60.0]
    return float(reached[0]) if reached.size else problem.duration


def quickest(task: Task, patterns: Sequence[str]) -> dict[str, float]:
    """By case, when the range is first reached with the largest target from the beginning on; without noise.

    More drug never raises the bis, so no controller is there earlier.
    """
    largest = fp.PID({"bis": -1e6}, {"bis": 0.0}, bumpless=False)  # at its limit until the bis is below the reference
    late = fp.Metric("late", first_below, better="smaller", finite=True)
    calm = replace(task.problem, sensing=fp.Sensing())
    metrics = (*task.metrics, late)
    held = replace(task, problem=calm, controllers={"largest": largest}, metrics=metrics, pictures=())
    with tempfile.TemporaryDirectory() as folder:
        study = fp.compare_scenarios(held, cases=patterns, controllers=["largest"], seed=0, folder=Path(folder))
        return {r["name"]: r["metrics"]["late"][""] for r in study.records["largest"]}


def with_believed(task: Task, reason: str) -> Task:
    """The task whose cases have one thing as the controllers believe it."""
    assert task.cases is not None
    changed: Mapping[str, object] = BELIEVED[reason]
    cases = fp.Cases({name: {**own, **changed} for name, own in task.cases.changes.items()})
    problem = replace(task.problem, sensing=fp.Sensing()) if reason == NOISELESS else task.problem
    return replace(task, problem=problem, cases=cases)


def print_reasons(task: Task, patterns: Sequence[str], controllers: Sequence[str]) -> None:
    """Print whom nobody can serve, and the figures with one thing as believed."""
    assert task.cases is not None
    times = quickest(task, patterns)
    late = {name: time for name, time in times.items() if time > LATEST}
    print(f"in the range later than {LATEST:g} min with the largest target: {len(late)} of {len(times)}")
    for name, time in late.items():
        print(f"  {name}  {f'{time:.1f} min' if time < task.problem.duration else 'never'}")
    for reason in BELIEVED:
        for (group, controller), values in of_seed(with_believed(task, reason), patterns, controllers, 0).items():
            cells = "  ".join(f"{name} {value:5.1f}" for name, value in zip(FIGURES, values, strict=True))
            print(f"{reason:12s}  {group:8s}  {controller:28s}  {cells}", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problem", nargs="?", default="anaesthesia_people")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cases", nargs="+", default=["all"])
    parser.add_argument("--reasons", action="store_true")
    parser.add_argument("--controllers", nargs="+")
    chosen = parser.parse_args()
    task = fp.load_problem(chosen.problem)
    controllers = chosen.controllers or list(task.controllers)
    if chosen.reasons:
        print_reasons(task, chosen.cases, controllers)
        return
    table = of_seeds(task, chosen.cases, controllers, chosen.seeds)
    width = max(len(f"{group}, {controller}") for group, controller in table)
    print(f"{'':{width}s}  {'  '.join(f'{name:>20s}' for name in FIGURES)}")
    for (group, controller), values in table.items():
        cells = (f"{np.median(v):.1f} ({v.min():.1f} to {v.max():.1f})" for v in values.T)
        print(f"{f'{group}, {controller}':{width}s}  {'  '.join(f'{cell:>20s}' for cell in cells)}")


if __name__ == "__main__":
    main()
