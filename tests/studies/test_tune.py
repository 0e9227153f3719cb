"""Tuning: the same budget and cost for all, never worse than before, and the same whether it is disturbed or not."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from helpers.line import EXACT, line_text

import fpirhc as fp
from fpirhc.errors import InvalidName, InvalidProblem, InvalidValue, NotSupported

TUNING = """tuning = {
    "CTC": {"tracking.rate": fp.Span(2.0, 12.0)},
    "CTC+FPI": {"deformation.gain": fp.LogSpan(-6.0, -0.05)},
}
"""
LINE = line_text("period=5e-3, duration=1.5, measure_from=0.5", "fp.Sigmoid(gain=-0.1, scale=20)", more=EXACT + TUNING)


@pytest.fixture
def task(tmp_path, monkeypatch):
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


@pytest.mark.parametrize("way", ["controller.", "", "controller.controller."])
def test_settings_are_changed_by_path_and_nothing_else_is(way):
    """Fields, keys of mappings and what any wrappers hold, named or not; the controller that was given stays as it was."""
    cost = fp.Quadratic(states={"q": 1.0, "q'": 2.0}, deviation={"u": 3.0})
    form = fp.ModelReferenced(fp.Filtered(fp.Sigmoid(gain=-0.5), pole=0.5))
    inner = fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-2), form, cost=cost)
    values = {"deformation.gain": -0.7, "deformation.shift": 0.2, "cost.states.q'": 5.0, "optimiser.iterations": 3}
    wrapped = fp.Predicted(fp.ExactModel(inner), inputs=0.1)
    changed: Any = fp.with_settings(wrapped, {f"{way}{path}": value for path, value in values.items()})
    assert changed.deformation == fp.ModelReferenced(fp.Filtered(fp.Sigmoid(gain=-0.7, shift=0.2), pole=0.5))
    assert dict(changed.controller.controller.cost.states) == {"q": 1.0, "q'": 5.0}
    assert changed.controller.controller.optimiser == fp.FixedPointSolver(iterations=3, tolerance=1e-2)
    assert inner.deformation == form


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
        with pytest.raises(InvalidValue, match=r"expected (a finite number|the smaller number first)"):
            kind(*wrong)
    with pytest.raises(InvalidValue, match="the same sign; use Span"):
        fp.LogSpan(-1.0, 1.0)


def test_failing_trials_cost_a_finite_penalty(task, tmp_path):
    """Gains far beyond the limit of contraction diverge, and a scale below zero is refused: the settings stay as they are."""
    wild = {"deformation.gain": fp.Span(-1e4, -1e3), "deformation.scale": fp.Span(1e5, 1e6)}
    for spans, expected in (
        (wild, {"deformation.gain": -0.1, "deformation.scale": 20.0}),
        ({"deformation.scale": fp.Span(-2.0, -1.0)}, {"deformation.scale": 20.0}),
    ):
        folder = tmp_path / "-".join(spans)
        tuned = fp.tune(replace(task, tuning={"CTC+FPI": spans}), trials=4, seed=0, folder=folder, compiled=False)
        assert tuned.settings() == {"CTC+FPI": expected}
        assert (tuned.table.cost == tuned.table.cost_before).all()
        values = [value for value in costs(folder) if value > tuned.table.cost[0]]
        assert len(values) == 4
        assert 10 <= min(values) <= max(values) <= 20  # ranges of the reference
        assert "gain" in "".join(spans) or min(values) == 20  # that did not even begin


def costs(folder: Path) -> list[float]:
    """The cost of every finished trial, as it stands in the file."""
    lines = [json.loads(line) for line in (folder / "trials.log").read_text().splitlines()]
    return [one["values"][0] for one in lines if one.get("values")]


def test_the_best_is_never_worse_and_costs_what_its_runs_say(task, tmp_path):
    """The cost is the mean relative error over the plants, which are the same for all trials; lines of Python give it."""
    draws = fp.Draws(3, 10.0, 7)
    tuned = fp.tune(task, trials=12, seed=1, variants=draws, controllers=["CTC+FPI"], folder=tmp_path, compiled=False)
    row, [gain] = tuned.table.iloc[0], tuned.settings()["CTC+FPI"].values()
    assert row.cost < row.cost_before
    for value, cost in ((gain, row.cost), (-0.1, row.cost_before)):
        controllers = {"one": fp.with_settings(task.controllers["CTC+FPI"], {"deformation.gain": value})}
        rows = fp.study(replace(task, controllers=controllers, tuning={}), draws, compiled=False).table
        assert cost == pytest.approx(rows.error.mean(), rel=1e-9)
    scope = {"controllers": dict(task.controllers), "fp": fp}
    exec(tuned.python(), scope)
    assert scope["controllers"]["CTC+FPI"].deformation.gain == gain


def test_a_metric_of_which_more_is_better_is_tuned_upwards(task, tmp_path):
    inside = fp.Metric("inside", lambda problem, run: float((abs(run["error.y"]) < 0.02).mean()), better="larger")
    task = replace(task, metrics=[*task.metrics, inside])
    facts = {"trials": 8, "seed": 0, "controllers": ["CTC"], "metric": "inside", "compiled": False}
    row = fp.tune(task, folder=tmp_path, **facts).table.iloc[0]
    assert row.cost <= row.cost_before < 0


def test_a_disturbed_search_finds_what_a_calm_one_finds(task, tmp_path):
    """Interrupted within a trial, or begun with fewer trials: the same trials, bit by bit. Trials beyond the tenth learn."""
    facts: dict[str, Any] = {"seed": 3, "variants": fp.Draws(2, 10.0, 3), "controllers": ["CTC+FPI"], "compiled": False}
    calm = fp.tune(task, trials=14, folder=tmp_path / "calm", **facts)

    def interrupt(name: str, done: int, of: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fp.tune(task, trials=14, folder=tmp_path / "cut", progress=interrupt, **facts)
    cut = tmp_path / "cut" / "trials.log"
    lines = cut.read_text().splitlines(keepends=True)
    cut.write_text("".join(lines[:-1]))  # the fifth was running
    assert len(costs(tmp_path / "cut")) == 4
    fp.tune(task, trials=11, folder=tmp_path / "cut", **facts)
    again = fp.tune(task, trials=14, folder=tmp_path / "cut", **facts)
    pd.testing.assert_frame_equal(again.table, calm.table)
    assert costs(tmp_path / "cut") == costs(tmp_path / "calm")


def test_other_plants_and_spans_are_another_search(task, tmp_path):
    """Their trials stand beside each other in one folder, and none counts for the other."""
    facts: dict[str, Any] = {"seed": 3, "controllers": ["CTC"], "compiled": False, "folder": tmp_path}
    fp.tune(task, trials=2, **facts)
    fp.tune(task, trials=2, variants=fp.Draws(2, 10.0, 3), **facts)
    wider = replace(task, tuning={"CTC": {"tracking.rate": fp.Span(1.0, 12.0)}})
    fp.tune(wider, trials=2, **facts)
    assert len(costs(tmp_path)) == 6
    fp.tune(task, trials=2, **facts)
    assert len(costs(tmp_path)) == 6


def test_what_cannot_be_tuned_is_said(task, tmp_path, monkeypatch):
    with pytest.raises(InvalidProblem, match=r"no search space for controller 'CTC exact'; add to its file.* tuning ="):
        fp.tune(task, trials=1, seed=0, folder=tmp_path, controllers=["CTC exact"])
    with pytest.raises(InvalidValue, match="trials 0: expected at least 1"):
        fp.tune(task, trials=0, seed=0, folder=tmp_path)
    zoned = replace(task, metrics=[*task.metrics, fp.Metric("zone", lambda problem, run: {"north": 1.0}, by="zone")])
    with pytest.raises(InvalidName, match=r"of 'CTC' has none\. Did you mean 'zone\.north'\? Valid: zone\.north\.$"):
        fp.tune(zoned, trials=1, seed=0, folder=tmp_path, controllers=["CTC"], metric="zone.nord", compiled=False)
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(NotSupported, match=r"pip install 'fpirhc\[tune\]'"):
        fp.tune(task, trials=1, seed=0, folder=tmp_path)


def test_settings_of_a_problem():
    """A parameter by its path; the problem stays as it is, and a wrong name is of the problem."""
    problem = fp.load_problem("two_mass").problem
    changed = fp.with_settings(problem, {"plant.parameters.m1.exact": 1.25})
    assert (changed.plant.parameters["m1"].exact, problem.plant.parameters["m1"].exact) == (1.25, 1.0)
    with pytest.raises(fp.FpirhcError, match=r"'plant\.parameters' of the problem has no 'm3'"):
        fp.with_settings(problem, {"plant.parameters.m3.exact": 1.0})
