"""Numbers in the descriptions of problems: every measured one stands in a table, and every table is read here.

A table gives rms errors in two digits; `fpirhc check` compares those of the baselines with fresh runs, and problems without a
baseline run in the slow lane.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.baselines.baseline import baseline_path, problems_here
from fpirhc.plant.motion import followed_units
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.shipped import missing

ROOT = Path(__file__).parents[2] / "problems"
FILES = sorted([*ROOT.glob("*.py"), *(ROOT / "gallery").glob("*.py"), *(ROOT / "outside").glob("*.py")])
HEAD = "rms error, seed 0"


def rows(text: str) -> list[list[str]]:
    """The table of a description, head first: cells are apart by two spaces or more."""
    lines = text.splitlines()
    first = next((k for k, line in enumerate(lines) if line.startswith(f"    {HEAD}")), None)
    if first is None:
        return []
    table = []
    for line in lines[first:]:
        if not line.startswith("    "):
            break
        table.append([cell.strip() for cell in line.strip().split("  ") if cell.strip()])
    return table


def loaded(path: Path) -> Task:
    """The problem, where its packages are installed."""
    if missing(path):
        pytest.skip(missing(path))
    return fp.load_problem(str(path))


def errors(task: Task, path: Path, controller: str) -> dict[str, float]:
    """The rms errors of the baseline, or of a run where there is none."""
    baseline = baseline_path(path)
    if baseline.exists():
        metrics = json.loads(baseline.read_text(encoding="utf-8"))["controllers"][controller]["metrics"]
        prefix = "rms_error."
        return {n.removeprefix(prefix): float(m[0]) for n, m in metrics.items() if n.startswith(prefix)}
    run = fp.simulate(task.problem, task.controllers[controller], seed=0)
    return dict(fp.measure(task.problem, run).rms_error)


def has_the_numbers_of_its_runs(task: Task, path: Path) -> None:
    """Every judged quantity with its unit, in two digits; a run on another machine may differ in the last one."""
    table = rows(task.description)
    assert table
    units = followed_units(task.problem.plant)
    names = task.problem.judged_names
    assert table[0] == [HEAD, *(f"{n} [{units[n]}]" for n in names)]
    assert len(table) > 2
    for controller, *numbers in table[1:]:
        error = errors(task, path, controller)
        for name, number in zip(names, numbers, strict=True):
            assert float(number) == pytest.approx(error[name], rel=0.05), (controller, name)


@pytest.mark.slow
@pytest.mark.parametrize("path", [p for p in FILES if not baseline_path(p).exists()], ids=lambda p: p.stem)
def test_a_table_without_a_baseline_is_what_runs_give(path):
    has_the_numbers_of_its_runs(loaded(path), path)


def test_every_problem_has_a_baseline_or_a_reason_why_not():
    """`fpirhc check` fails for any other."""
    problems = problems_here(ROOT.parent)
    assert [path.stem for path in problems if not baseline_path(path).exists()] == []
    assert len(problems) > 20
