"""A plant names its unit of time, and every result says it: a tumour grows in days."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure

import fpirhc as fp
from fpirhc.baselines.baseline import settings_of
from fpirhc.errors import InvalidProblem
from fpirhc.plant.motion import forcing_units
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.figures import pair_figures, plan_figure
from fpirhc.report.html import chart_data, headline_pair, render, render_scenarios
from fpirhc.report.terminal import show
from fpirhc.studies.comparison.compare import compare
from fpirhc.studies.comparison.comparison import Comparison
from fpirhc.studies.open_loop import solve_first
from fpirhc.studies.scenarios.scenario_study import compare_scenarios

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
    """The text of a page, without code, styles and pictures."""
    return re.sub(r"<(script|style)>.*?</\1>|data:image[^']*", " ", page, flags=re.DOTALL)


def test_the_plant_names_the_unit_and_derivatives_have_it(case):
    """Signals of the run carry it: time, derivatives, integrals; and the unit of a problem is that of its plant."""
    task, comparison = case
    run = comparison.entries[1].run
    order = task.problem.plant.orders[0]
    first = task.problem.plant.names[0]
    assert task.problem.time_unit == run.time_unit == run.unit("time") == UNIT
    assert run.unit(f"desired.{first}") == (VELOCITY if order == 1 else f"{VELOCITY}^{order}")
    assert run.to_dataframe().index.name == f"time [{UNIT}]"
    assert not [u for u in run.layout.units if SECONDS.search(f"[{u}]")]


def test_metrics_and_short_forms_have_it(case):
    """Headings of the table, and the line and the small table that a terminal and a notebook show."""
    task, comparison = case
    entry = comparison.entries[1]
    first = task.problem.plant.names[0]
    assert entry.metrics.units["settling"][first] == UNIT
    assert entry.metrics.units["iae"][first] == f"{task.problem.plant.coordinates[first]} {UNIT}"
    assert f"cycles of {task.problem.period:g} {UNIT}" in repr(entry.run)
    assert not SECONDS.search(entry.run._repr_html_() + entry.metrics._repr_html_() + comparison._repr_html_())


def test_report_and_terminal_have_it(case, capsys, tmp_path):
    """Table, captions, charts: nothing in a page says seconds."""
    task, comparison = case
    whole = render(comparison)
    page = ALLOWED.sub("", without_scripts(whole))
    assert f"from t = {task.problem.measure_from:g} {UNIT} on" in page
    assert not SECONDS.search(page)
    data = chart_data(comparison)
    assert data["timeUnit"] == UNIT
    assert not [c["unit"] for c in data["charts"] if SECONDS.search(f"[{c['unit']}]")]
    assert "t [s]" not in whole
    show(comparison.view, tmp_path / "report.html")
    shown = capsys.readouterr().out
    assert f"t = {task.problem.measure_from:g} {UNIT}" in shown
    assert not SECONDS.search(shown)


def labels(figure: Figure) -> list[str]:
    """Every text of a figure's axes."""
    legends = [text.get_text() for axis in figure.axes if (legend := axis.get_legend()) for text in legend.get_texts()]
    return legends + [text for axis in figure.axes for text in (axis.get_xlabel(), axis.get_ylabel(), axis.get_title())]


def test_figures_have_it(case):
    """Axes and legends of runs, pairs and plans, and of the pictures that a problem wants."""
    task, comparison = case
    pair = headline_pair(comparison)
    assert pair is not None
    figures = [*pair_figures(*pair).values(), pair[1].run.plot()]
    solved = solve_first(task, ["fixed-point"], 1e-6)
    figures.append(plan_figure(task.problem, solved))
    for wanted in task.pictures:
        figures.append(Figure())
        wanted.draw(figures[-1], {e.name: e.run for e in comparison.entries})
    texts = [text for figure in figures for text in labels(figure)]
    assert f"time [{UNIT}]" in texts
    assert not [text for text in texts if SECONDS.search(text)]
    assert f"of {task.problem.horizon.step:g} {UNIT}" in repr(solved[0].plan)


def test_scenarios_have_it(case, capsys, tmp_path):
    task, _ = case
    study = compare_scenarios(
        task, count=2, percent=5.0, seed=0, folder=tmp_path, controllers=["RHC", "RHC+FPI"], compiled=False
    )
    show(study.view, tmp_path / "report.html")
    page = ALLOWED.sub("", without_scripts(render_scenarios(study)))
    for text in (page, " ".join(capsys.readouterr().out.split())):
        assert f"t = {task.problem.measure_from:g} {UNIT}" in text
        assert not SECONDS.search(text)


def test_messages_have_it(case):
    """A period that does not divide the horizon step, and a run that ends early."""
    task, _ = case
    problem = task.problem
    with pytest.raises(InvalidProblem, match=rf"{problem.period * 1.3:g} {UNIT} does not divide .* {UNIT}"):
        replace(problem, period=problem.period * 1.3)
    with pytest.raises(InvalidProblem, match=r"in the plant's unit of time, got -1\.0"):
        replace(problem, period=-1.0)


def test_a_unit_of_time_is_a_name_and_no_setting(case):
    """Naming the unit changes no number, so no baseline becomes stale; an empty unit is refused."""
    task, _ = case
    unnamed = replace(task.problem, plant=replace(task.problem.plant, time_unit="s"))
    assert settings_of(replace(task, problem=unnamed)) == settings_of(task)
    with pytest.raises(InvalidProblem, match="time_unit is ''"):
        replace(task.problem.plant, time_unit="")


def test_a_comparison_of_seconds_says_seconds():
    """The default is SI: 'm/s^2', 's'."""
    plant = fp.load_problem("two_mass").problem.plant
    assert (plant.time_unit, forcing_units(plant)[0], Comparison.time_unit) == ("s", "m/s^2", "s")
