"""A plant whose time is in days says days: signals, metrics, pages, terminals, figures, studies and messages."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import fpirhc as fp
from fpirhc import compare, study
from fpirhc.describe import digest
from fpirhc.errors import InvalidProblem
from fpirhc.plant.motion import forcing_units
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.figures import plan_figure
from fpirhc.report.html import chart_data, render, render_charted
from fpirhc.report.terminal import show
from fpirhc.studies.comparison.compare import Comparison
from fpirhc.studies.open_loop import first_plans
from fpirhc.studies.study import write_csv
from fpirhc.studies.variants import Draws

GALLERY = Path(__file__).parents[2] / "problems" / "gallery"
UNIT, VELOCITY = "day", "ln(mm^3)/day"
SECONDS = re.compile(r"\d s\b|\[s\]|\b1/s\b|/s\^|[A-Za-z\)]/s\b| s\]")  # a number in seconds, or a unit that has them
ALLOWED = re.compile(r"took [\d.]+ s\.")  # wall time


@pytest.fixture(scope="module")
def case() -> tuple[Task, Comparison]:
    """The shipped task, cut short, and the comparison of its headline's pair."""
    task = fp.load_problem(str(GALLERY / "tumour_daily.py"))
    task = replace(task, problem=replace(task.problem, duration=30.0, measure_from=10.0))
    return task, compare(task, seed=0, controllers=["RHC", "RHC+FPI"], compiled=False)


def without_scripts(page: str) -> str:
    """The text of a page, without code, styles, pictures and wall times."""
    return ALLOWED.sub("", re.sub(r"<(script|style)>.*?</\1>|data:image[^']*", " ", page, flags=re.DOTALL))


def test_signals_and_metrics_have_it(case):
    """Time, derivatives, integrals; the unit of a problem is that of its plant, and the short forms say it."""
    task, comparison = case
    entry = comparison.entries[1]
    run, first = entry.run, task.problem.plant.names[0]
    assert task.problem.time_unit == run.time_unit == run.unit("time") == UNIT
    assert run.unit(f"desired.{first}") == f"{VELOCITY}^{task.problem.plant.orders[0]}".removesuffix("^1")
    assert run.to_dataframe().index.name == f"time [{UNIT}]"
    assert not [u for u in run.layout.units if SECONDS.search(f"[{u}]")]
    assert entry.metrics.units["settling"][first] == UNIT
    assert f"cycles of {task.problem.period:g} {UNIT}" in repr(run)
    assert not SECONDS.search(run._repr_html_() + entry.metrics._repr_html_() + comparison._repr_html_())


def test_page_and_terminal_have_it(case, capsys, tmp_path):
    """Table, captions, charts: nothing says seconds."""
    task, comparison = case
    page = without_scripts(render(comparison))
    assert f"from t = {task.problem.measure_from:g} {UNIT} on" in page
    data: Any = chart_data(comparison)
    assert data["timeUnit"] == UNIT
    show(comparison.view, tmp_path / "report.html")
    shown = capsys.readouterr().out
    assert not SECONDS.search(page + shown)
    assert not [c["unit"] for c in data["charts"] if SECONDS.search(f"[{c['unit']}]")]


def test_figures_have_it(case):
    task, comparison = case
    plans = plan_figure(task.problem, first_plans(task, ["fixed-point"], ["RHC"]))
    for figure in (comparison.entries[1].run.plot(), plans):
        texts = [text for axis in figure.axes for text in (axis.get_xlabel(), axis.get_ylabel(), axis.get_title())]
        assert any(f"[{UNIT}]" in text for text in texts)
        assert not [text for text in texts if SECONDS.search(text)]


def test_a_study_has_it(case, capsys, tmp_path):
    task, _ = case
    found = study(task, Draws(2, 5.0), controllers=["RHC", "RHC+FPI"], compiled=False)
    show(found.view, tmp_path / "report.html")
    for text in (without_scripts(render_charted(found.view)), capsys.readouterr().out):
        assert not SECONDS.search(text)
    write_csv(found.table, tmp_path / "study.csv")
    heads = (tmp_path / "study.csv").read_text().splitlines()[0]
    assert f"[{UNIT}]" in heads
    assert not SECONDS.search(heads)


def test_messages_have_it(case):
    """A period that does not divide the horizon step, and one that is none."""
    problem = case[0].problem
    with pytest.raises(InvalidProblem, match=rf"{problem.period * 1.3:g} {UNIT} does not divide .* {UNIT}"):
        replace(problem, period=problem.period * 1.3)
    with pytest.raises(InvalidProblem, match=r"in the plant's unit of time, got -1\.0"):
        replace(problem, period=-1.0)


def test_a_unit_of_time_is_a_name_and_no_setting(case):
    """Naming the unit changes no number, so no kept row becomes another study's; an empty unit is refused; the default is SI."""
    problem = case[0].problem
    assert digest(replace(problem, plant=replace(problem.plant, time_unit="s"))) == digest(problem)
    with pytest.raises(InvalidProblem, match="time_unit is ''"):
        replace(problem.plant, time_unit="")
    plant = fp.load_problem("two_mass").problem.plant
    assert (plant.time_unit, forcing_units(plant)[0]) == ("s", "m/s^2")
