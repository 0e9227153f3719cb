"""Tuning: the same budget and cost for all, never worse than before, and the same whether it is disturbed or not."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from line import EXACT, line_text

import fpirhc as fp
from fpirhc.errors import InvalidName, InvalidProblem, InvalidValue, NotSupported, OutputError
from fpirhc.problem_files.settings import current_setting, is_whole
from fpirhc.studies.objective import PENALTY, objective

TUNING = """tuning = {
    "CTC": {"tracking.rate": fp.Span(2.0, 12.0)},
    "CTC+FPI": {"deformation.gain": fp.LogSpan(-6.0, -0.05)},
}
"""
LINE = line_text(
    "period=5e-3, duration=1.5, measure_from=0.5", "fp.Sigmoid(gain=-0.1, scale=20.0)", more=EXACT + TUNING
)


@pytest.fixture
def task(tmp_path, monkeypatch):
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


# --- Settings by path -------------------------------------------------------------------------------------------------


def test_settings_are_changed_by_path_and_nothing_else_is():
    """Fields, keys of mappings and wrapped controllers; the controller that was given stays as it was."""
    cost = fp.Quadratic(states={"q": 1.0, "q'": 2.0}, deviation={"u": 3.0})
    inner = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-2), fp.Sigmoid(gain=-0.5), cost=cost)
    values = {
        "controller.deformation.gain": -0.7,
        "controller.cost.states.q'": 5.0,
        "controller.optimiser.iterations": 3,
    }
    changed: Any = fp.with_settings(fp.ExactModel(inner), values)
    assert changed.controller.deformation == fp.Sigmoid(gain=-0.7)
    assert dict(changed.controller.cost.states) == {"q": 1.0, "q'": 5.0}
    assert changed.controller.optimiser == fp.FixedPoint(iterations=3, tolerance=1e-2)
    assert inner.deformation == fp.Sigmoid(gain=-0.5)
    for path, value in values.items():
        assert current_setting(changed, path) == value
    assert is_whole(fp.ExactModel(inner), "controller.optimiser.iterations")
    assert not is_whole(fp.ExactModel(inner), "controller.deformation.gain")


@pytest.mark.parametrize(
    ("path", "error", "message"),
    [
        ("deformation.gian", InvalidName, r"\(Sigmoid\) has no 'gian'.*Did you mean 'gain'"),
        ("deformatoin.gain", InvalidName, "Did you mean 'deformation'"),
        ("deformation", InvalidValue, "not a number; go on with one of: gain, shift, scale"),
        ("deformation.scale", InvalidValue, "is None, not a number; give it a number first"),
        ("deformation.gain.x", InvalidName, "has no 'x'"),
    ],
)
def test_wrong_paths_get_the_nearest_name(path, error, message):
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5))
    with pytest.raises(error, match=message):
        fp.with_settings(controller, {path: 1.0})


# --- Search spaces ----------------------------------------------------------------------------------------------------


def test_spans_go_from_end_to_end():
    """Half-way is the arithmetic or the geometric mean; four digits, because those are written down."""
    assert [fp.Span(1.0, 3.0).number(s) for s in (0.0, 0.5, 1.0)] == [1.0, 2.0, 3.0]
    assert [fp.LogSpan(0.01, 1.0).number(s) for s in (0.0, 0.5, 1.0)] == [0.01, 0.1, 1.0]
    assert [fp.LogSpan(-1.0, -0.01).number(s) for s in (0.0, 0.5, 1.0)] == [-1.0, -0.1, -0.01]
    assert fp.Span(0.0, 1.0).number(1 / 3) == 0.3333
    assert fp.Span(0.0, 0.33333).number(1.0) <= 0.33333


@pytest.mark.parametrize("wrong", [(2.0, 1.0), (1.0, 1.0), (0.0, float("inf")), ("a", 1.0)])
def test_spans_are_checked(wrong):
    for kind in (fp.Span, fp.LogSpan):
        with pytest.raises(InvalidValue, match="expected two finite numbers, the smaller one first"):
            kind(*wrong)
    with pytest.raises(InvalidValue, match="the same sign; use Span"):
        fp.LogSpan(-1.0, 1.0)


# --- Tuning -----------------------------------------------------------------------------------------------------------


def records(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "trials.jsonl").read_text().splitlines()[1:]]


@pytest.mark.parametrize(
    ("metric", "error", "message"),
    [
        ("max_eror.y", InvalidName, "Did you mean 'max_error'"),
        ("max_error", InvalidValue, "a number for every coordinate"),
        ("effort.u", InvalidValue, "no better direction"),
        ("max_error.z", InvalidName, "Did you mean 'max_error.y'"),
        ("cost.total", InvalidValue, r"'cost\.total' needs Problem\(horizon=\.\.\., cost="),
    ],
)
def test_a_wrong_metric_is_refused(metric, error, message, task, tmp_path):
    with pytest.raises(error, match=message):
        fp.tune(task, trials=1, seed=0, folder=tmp_path / "t", metric=metric)


def test_a_run_that_fails_costs_more_than_any_metric(task):
    """Between one and two penalties, less if it lasted long; settings that cannot run cost two."""
    aim = objective("max_error.y", task.metrics, task.problem)
    record = {"outcome": "ended early", "error": None, "lasted": 0.25, "metrics": {"max_error": {"y": None}}}
    finished = {
        "controller": "RHC",
        "outcome": "finished",
        "error": 0.1,
        "lasted": 1.0,
        "metrics": {"max_error": {"y": 3e5}},
    }
    assert aim.cost(finished) == 3e5
    assert 3e5 < aim.cost({**record, "lasted": 0.75}) < aim.cost(record) < aim.refused == aim.cost({"skipped": "why"})


def test_failing_trials_cost_a_finite_penalty(task, tmp_path):
    """Gains far beyond the limit of contraction diverge: finite, and above everything that works."""
    wild = replace(
        task, tuning={"CTC+FPI": {"deformation.gain": fp.Span(-1e4, -1e3), "deformation.scale": fp.Span(1e5, 1e6)}}
    )
    tuned = fp.tune(wild, trials=4, seed=0, folder=tmp_path / "t")
    costs = [r["cost"] for r in records(tmp_path / "t")]
    assert all(0 < c <= 2 * PENALTY for c in costs)
    assert tuned.entries[0].failed == 4
    assert tuned.entries[0].settings == {"deformation.gain": -0.1, "deformation.scale": 20.0}
    refused = replace(task, tuning={"CTC+FPI": {"deformation.scale": fp.Span(-2.0, -1.0)}})
    tuned = fp.tune(refused, trials=1, seed=0, folder=tmp_path / "refused")
    assert records(tmp_path / "refused")[1]["cost"] == 2 * PENALTY
    assert tuned.entries[0].settings == {"deformation.scale": 20.0}


def test_a_disturbed_study_finds_what_a_calm_one_finds(task, tmp_path):
    """Cut anywhere and gone on with, or begun with fewer trials: the same trials, bit by bit. Trials beyond the tenth learn."""
    settings: dict[str, Any] = {"seed": 3, "count": 2, "percent": 10.0, "controllers": ["CTC+FPI"]}
    calm = fp.tune(task, trials=14, folder=tmp_path / "calm", **settings)
    fp.tune(task, trials=5, folder=tmp_path / "cut", **settings)
    content = (tmp_path / "cut" / "trials.jsonl").read_bytes()
    (tmp_path / "cut" / "trials.jsonl").write_bytes(content[:-7])
    again = fp.tune(task, trials=14, folder=tmp_path / "cut", **settings)
    assert (tmp_path / "cut" / "trials.jsonl").read_bytes() == (tmp_path / "calm" / "trials.jsonl").read_bytes()
    assert again.facts() == calm.facts()
    with pytest.raises(OutputError, match="seed was 3, is 4"):
        fp.tune(task, trials=14, folder=tmp_path / "cut", **{**settings, "seed": 4})


def test_a_generation_that_was_interrupted_goes_on_as_it_would_have_done(task, tmp_path):
    """Within the first trials, which are random, and within those that learn; no finished trial is run again."""
    facts: dict[str, Any] = {"seed": 0, "compiled": False, "population": 4, "controllers": ["CTC"]}

    def lines(folder: str) -> list[str]:
        return (tmp_path / folder / "trials.jsonl").read_text().splitlines(keepends=True)

    fp.tune(task, trials=20, folder=tmp_path / "whole", **facts)
    for finished in (2, 14):
        folder = tmp_path / f"after {finished}"
        folder.mkdir()
        (folder / "trials.jsonl").write_text(
            "".join(lines("whole")[: 2 + finished])
        )  # the header, the settings as they are
        fp.tune(task, trials=20, folder=folder, **facts)
        assert lines(folder.name) == lines("whole")


def test_what_cannot_be_tuned_is_said(task, tmp_path, monkeypatch):
    with pytest.raises(InvalidProblem, match="no search space for controller 'CTC exact'"):
        fp.tune(task, trials=1, seed=0, folder=tmp_path, controllers=["CTC exact"])
    with pytest.raises(InvalidProblem, match=r"add to its file, for example, tuning ="):
        fp.tune(replace(task, tuning={}), trials=1, seed=0, folder=tmp_path)
    with pytest.raises(InvalidValue, match="trials 0: expected at least 1"):
        fp.tune(task, trials=0, seed=0, folder=tmp_path)
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(NotSupported, match=r"pip install 'fpirhc\[tune\]'"):
        fp.tune(task, trials=1, seed=0, folder=tmp_path)


def test_a_search_space_that_is_missing_is_offered_for_a_controller_that_adapts(tmp_path):
    """The gain of the first one that has any, around its number; a problem without one is offered a rate."""
    task = fp.load_problem("leaking_tanks")
    with pytest.raises(
        InvalidProblem, match=r"tuning = \{'RHC\+FPI': \{'deformation\.gain': fpirhc\.LogSpan\(-6, -0\.2\)\}\}"
    ):
        fp.tune(task, trials=1, seed=0, folder=tmp_path, controllers=["RHC"])
    alone = replace(task, controllers={"RHC": task.controllers["RHC"]}, headline=None)
    with pytest.raises(InvalidProblem, match=r"tuning = \{'RHC': \{'tracking\.rate'"):
        fp.tune(alone, trials=1, seed=0, folder=tmp_path)


def test_settings_of_a_problem():
    """A parameter by its path; the problem stays as it is, and a wrong name is of the problem."""
    problem = fp.load_problem("two_mass").problem
    changed = fp.with_settings(problem, {"plant.parameters.m1.exact": 1.25})
    assert (changed.plant.parameters["m1"].exact, problem.plant.parameters["m1"].exact) == (1.25, 1.0)
    with pytest.raises(fp.FpirhcError, match=r"'plant\.parameters' of the problem has no 'm3'"):
        fp.with_settings(problem, {"plant.parameters.m3.exact": 1.0})
