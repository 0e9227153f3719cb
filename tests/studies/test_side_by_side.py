"""Studies whose runs are side by side say what the ordinary runs say, one after the other."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tasks

import fpirhc as fp
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.tune import tune

SMOOTH, ROUNDED = 1e-12, 1e-9  # relative; behind a quantum a last place is now and then a whole one
_SHORT: dict[str, Any] = {"duration": 2.0, "measure_from": 0.5}


def short(task: Task, **changes: Any) -> Task:
    return replace(task, problem=replace(task.problem, **{**_SHORT, **changes}))


def test_costs_of_a_search_are_those_of_single_runs(tmp_path: Path) -> None:
    spans = {"CTC+FPI (eq 6)": {"deformation.gain": fp.LogSpan(-1.2, -0.2)}}
    task = replace(short(tasks.two_mass), tuning=spans)
    settings: dict[str, Any] = {"trials": 3, "seed": 1, "count": 32, "percent": 10.0, "controllers": list(spans)}
    lanes = tune(task, folder=tmp_path / "lanes", **settings).entries[0]
    plain = tune(task, folder=tmp_path / "plain", **settings, compiled=False).entries[0]
    assert lanes.cost == pytest.approx(plain.cost, rel=SMOOTH)
    assert lanes.settings == pytest.approx(plain.settings, rel=SMOOTH)
    first = json.loads((tmp_path / "lanes" / "trials.jsonl").read_text().splitlines()[1])
    assert first["failures"] == 0


def test_a_population_is_judged_as_its_members_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    """Every trial has the cost of a search that runs its trials one after the other in scenarios one after the other."""
    spans = {"CTC+FPI (eq 6)": {"deformation.gain": fp.LogSpan(-1.2, -0.2)}}
    task = replace(short(tasks.two_mass), tuning=spans)
    settings: dict[str, Any] = {"trials": 24, "seed": 1, "count": 3, "percent": 10.0, "population": 8}
    whole = tune(task, folder=tmp_path / "whole", **settings)
    plain = tune(task, folder=tmp_path / "plain", **settings, compiled=False)
    one, other = (
        [json.loads(line) for line in (tmp_path / name / "trials.jsonl").read_text().splitlines()[1:]]
        for name in ("whole", "plain")
    )
    assert [r["trial"] for r in one] == list(range(-1, 24))
    for record, expected in zip(one, other, strict=True):
        assert record["settings"] == pytest.approx(expected["settings"], rel=1e-9)
        assert record["cost"] == pytest.approx(expected["cost"], rel=1e-9)
    assert whole.entries[0].cost < whole.entries[0].cost_before
    assert plain.entries[0].settings == pytest.approx(whole.entries[0].settings, rel=1e-9)
    lines = (tmp_path / "whole" / "trials.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "trials.jsonl").write_text("".join(lines[:13]))  # in the middle of the second generation
    again = tune(task, folder=tmp_path / "cut", **settings)
    assert again.entries[0].cost == whole.entries[0].cost
    assert (tmp_path / "cut" / "trials.jsonl").read_text() == "".join(lines)
