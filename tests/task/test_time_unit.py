"""A plant names its unit of time, and every result says it: a tumour grows in days."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem

UNIT, VELOCITY = "day", "ln(mm^3)/day"
SECONDS = re.compile(r"\d s\b|\[s\]|\b1/s\b|/s\^|[A-Za-z\)]/s\b| s\]")  # a number in seconds, or a unit that has them


@pytest.fixture(scope="module")
def comparison():
    """The shipped task, cut short, and the comparison of its headline's pair."""
    task = fp.load_problem("tumour_daily")
    task = replace(task, problem=replace(task.problem, duration=30.0, measure_from=10.0))
    return task.problem, fp.compare(task, seed=0, controllers=["RHC", "RHC+FPI"], compiled=False)


def test_the_plant_names_the_unit_and_derivatives_have_it(comparison):
    """Signals of the run carry it: time, derivatives, integrals; and the unit of a problem is that of its plant."""
    problem, compared = comparison
    run, [first], [order] = compared.entries[1].run, problem.plant.names[:1], problem.plant.orders[:1]
    assert problem.time_unit == run.time_unit == run.unit("time") == UNIT
    assert run.unit(f"desired.{first}") == (VELOCITY if order == 1 else f"{VELOCITY}^{order}")
    assert run.to_dataframe().index.name == f"time [{UNIT}]"
    assert not [u for u in run.layout.units if SECONDS.search(f"[{u}]")]


def test_metrics_and_short_forms_have_it(comparison):
    """Headings of the table, and the line and the small table that a terminal and a notebook show."""
    problem, compared = comparison
    entry, first = compared.entries[1], problem.plant.names[0]
    assert entry.metrics.units["settling"][first] == UNIT
    assert entry.metrics.units["iae"][first] == f"{problem.plant.coordinates[first]} {UNIT}"
    assert f"cycles of {problem.period:g} {UNIT}" in repr(entry.run)
    assert not SECONDS.search(entry.run._repr_html_() + entry.metrics._repr_html_() + compared._repr_html_())


def test_a_report_has_it(comparison, tmp_path):
    """Nothing in a page says seconds, but the time that was measured on a wall clock."""
    problem, compared = comparison
    fp.write_report(compared, tmp_path / "report.html")
    whole = (tmp_path / "report.html").read_text()
    page = re.sub(r"<(script|style)[^>]*>.*?</\1>|data:image[^']*", " ", whole, flags=re.DOTALL)
    assert f"{problem.measure_from:g} {UNIT}" in page
    assert not SECONDS.search(re.sub(r"took [\d.]+ s\.", "", page))
    assert "t [s]" not in whole
    assert not [axis.get_xlabel() for axis in compared.entries[1].run.plot().axes if SECONDS.search(axis.get_xlabel())]


def test_messages_have_it(comparison):
    problem, _ = comparison
    with pytest.raises(InvalidProblem, match=rf"{problem.period * 1.3:g} {UNIT} does not divide .* {UNIT}"):
        replace(problem, period=problem.period * 1.3)
    with pytest.raises(InvalidProblem, match=r"in the plant's unit of time, got -1\.0"):
        replace(problem, period=-1.0)
    with pytest.raises(InvalidProblem, match="time_unit is ''"):
        replace(problem.plant, time_unit="")


def test_a_name_changes_no_number(comparison):
    problem, compared = comparison
    unnamed = replace(problem, plant=replace(problem.plant, time_unit="s"))
    run = fp.simulate(unnamed, fp.load_problem("tumour_daily").controllers["RHC"], seed=0, compiled=False)
    assert (run["command"] == compared.entries[0].run["command"]).all()
    assert run.unit("time") == "s"
