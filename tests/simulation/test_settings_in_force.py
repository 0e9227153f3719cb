"""Which live settings were in force when: in a run, in its file, in pictures and in the report."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import tasks

import fpirhc as fp
from fpirhc.errors import InvalidProblem
from fpirhc.report.html import render
from fpirhc.report.terminal import settings_in_force
from fpirhc.simulation.run import load_run
from fpirhc.studies.comparison.compare import compare
from fpirhc.studies.comparison.comparison import Comparison

NAME, GAIN, SCALE = "CTC+FPI (eq 6)", "deformation.gain", "deformation.scale"
CHANGES = {0.1: {GAIN: -0.9}, 0.2: {GAIN: -0.9, SCALE: 3.0}}
first_settings = cache(
    lambda: {
        path: getattr(tasks.two_mass.controllers[NAME].deformation, path.partition(".")[2]) for path in (GAIN, SCALE)
    }
)


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    """A plain controller and an adaptive one whose settings change twice."""
    task = replace(tasks.two_mass, problem=replace(tasks.two_mass.problem, duration=0.3, measure_from=0.0))
    return compare(task, seed=0, controllers=["CTC", NAME], compiled=False, changes={NAME: CHANGES})


def test_a_run_knows_what_was_in_force_when(comparison, tmp_path):
    """Times of cycles and all numbers; a run without live settings has none; a file keeps them."""
    run = comparison[NAME].run
    assert [time for time, _ in run.in_force] == [0.0, 0.1, 0.2]
    assert [dict(numbers) for _, numbers in run.in_force] == [
        first_settings(),
        {GAIN: -0.9, SCALE: first_settings()[SCALE]},
        {GAIN: -0.9, SCALE: 3.0},
    ]
    assert comparison["CTC"].run.in_force == ()
    run.save(tmp_path / "run.npz")
    assert load_run(tmp_path / "run.npz").in_force == run.in_force
    assert settings_in_force(run)[1] == f"settings from 0.1 s: {GAIN} = -0.9, {SCALE} = {first_settings()[SCALE]:g}"


def test_the_report_has_a_table_of_what_changed(comparison):
    """All numbers at the start, then those that became other ones, by controller and time."""
    page = render(comparison)
    section = re.search(r"<section id='in-force'>.*?</section>", page, re.DOTALL)
    assert section
    rows = [re.findall(r">([^<]+)</t[hd]>", row) for row in section[0].split("<tr>")[2:]]
    starts = [[NAME, "0", path, f"{first_settings()[path]:.6g}"] for path in (GAIN, SCALE)]
    assert sorted(rows) == sorted([*starts, [NAME, "0.1", GAIN, "-0.9"], [NAME, "0.2", SCALE, "3"]])
    controllers = json.JSONDecoder().raw_decode(page.partition("const DATA=")[2])[0]["controllers"]
    assert {c["name"]: c["changes"] for c in controllers} == {"CTC": [], NAME: [0.1, 0.2]}


def test_pictures_mark_the_changes(comparison):
    """A vertical line at every change in every part of a run's picture, and none without changes."""

    def marks(run: fp.Run) -> list[list[float]]:
        dotted = [[line for line in axis.lines if line.get_linestyle() == ":"] for axis in run.plot().axes]
        times = [[np.asarray(line.get_xdata(), dtype=float) for line in part] for part in dotted]
        return [[float(x[0]) for x in part if x[0] == x[-1]] for part in times]

    assert marks(comparison[NAME].run) == [[0.1, 0.2]] * 4
    assert marks(comparison["CTC"].run) == [[]] * 4


def test_changes_of_unknown_controllers_are_refused():
    with pytest.raises(InvalidProblem, match=r"changes.*eq 6"):
        compare(tasks.two_mass, seed=0, controllers=["CTC", NAME], changes={"CTC+FPI (eq6)": CHANGES})


def test_limits_count_from_when_they_are_in_force():
    """The share of cycles at a limit is that of cycles that were clipped, also where the limit comes during the run."""
    problem = replace(tasks.two_mass.problem, duration=0.2, measure_from=0.05)
    ready = fp.simulator(problem, tasks.two_mass.controllers["CTC"], live=["limits.inputs.Q1"], compiled=False)
    free = ready.run(seed=0)["command.Q1"]
    run = ready.run(seed=0, changes={0.1: {"limits.inputs.Q1": (-200.0, float(free[len(free) // 2 :].min()))}})
    counts = run["clipped"][np.round(run.time / problem.period) >= round(0.05 / problem.period)]
    assert fp.measure(problem, run).at_limit == counts.mean() > 0.2
