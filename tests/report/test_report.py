"""The report: one file, safe, complete, or not there."""

import base64
import hashlib
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import pytest
from helpers import tasks
from helpers.plants import sine_of_three

import fpirhc as fp
from fpirhc.errors import OutputError


def problem() -> fp.Problem:
    """A linear plant with a wrong model that follows a sine."""
    noise = {"u": fp.Noise(0.01)}
    return replace(sine_of_three(), start={"y": 0.3}, duration=1.0, measure_from=0.0, disturbances=noise)


def compared(*controllers: str, **changes: Any) -> Any:
    """A pair of controllers with and without adaptation, and one with the exact model."""
    track, form = fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5, scale=5.0)
    every = {"plain": fp.ComputedTorque(track), "adaptive": fp.ComputedTorque(track, form)}
    every["exact"] = fp.ExactModel(every["plain"])
    task = tasks.made(replace(problem(), **changes), every, description="    y = 2 x\n\nIts task.")
    return fp.compare(task, controllers=controllers or None, seed=0, compiled=False)


@pytest.fixture(scope="module")
def comparison() -> Any:
    return compared()


def data_of(page: str) -> Any:
    """What the charts of a page show."""
    begin = page.index("DATA", page.index('{"controllers"') - 20)
    return json.JSONDecoder().raw_decode(page[page.index("{", begin) :])[0]


@pytest.fixture(scope="module")
def written(comparison, tmp_path_factory) -> Path:
    path: Path = tmp_path_factory.mktemp("report") / "report.html"
    fp.write_report(comparison, path)
    return path


def test_report_is_self_contained_and_small(written):
    """It opens offline: nothing is fetched, everything is inside; the verdict comes first, then what a reader asks next."""
    whole = written.read_text(encoding="utf-8")
    assert len(whole) < 3_000_000
    assert not re.search(r"""(src|href)\s*=\s*['"](?!data:)""", whole)
    assert "@import" not in whole
    assert [p.name for p in written.parent.iterdir()] == ["report.html"]
    marks = ("id='verdict'", "<table>", "<h2>Signals over time", "<h3>Contraction", "<h2>The problem", "<h2>Settings")
    places = [whole.index(mark) for mark in marks]
    assert places == sorted(places)
    settings = whole[whole.index("<h2>Settings") :]  # as Python, and only what is no default
    assert "<pre>fp.ExactModel(controller=fp.ComputedTorque(tracking=fp.Exponential(rate=6.0)))</pre>" in settings
    assert "deformation=fp.Sigmoid(gain=-0.5, scale=5.0)" in settings
    assert "<pre class='about'>y = 2 x</pre><p class='about'>Its task.</p>" in whole


def test_no_factor_is_the_best_and_no_number_of_those_that_do_not_follow(comparison):
    [shown] = comparison.view.tables
    marked = {shown.columns[k].head for row in shown.rows for k in row.best}
    assert "rms error y [m]" in marked
    assert not any("contraction" in head for head in marked)
    lost = compared(limits=fp.Limits(inputs={"u": (-0.01, 0.01)}), duration=3.0)  # the mass goes on
    assert "No controller follows" in " ".join(lost.verdict)
    assert not any(row.best for row in lost.view.tables[0].rows)
    assert {row.cells[1].partition(",")[0] for row in lost.view.tables[0].rows} == {"does not follow"}
    [quick] = compared("plain", period=1e-9, duration=1e-8).view.tables[0].rows  # no call is done in a nanosecond
    assert "late 100 %" in quick.cells[1]


def test_data_of_the_charts_is_complete(comparison, written):
    """Every controller and no peak lost."""
    data = data_of(written.read_text(encoding="utf-8"))
    assert [c["name"] for c in data["controllers"]] == ["plain", "adaptive", "exact"]
    error, run = next(c for c in data["charts"] if c["title"] == "error of y"), comparison["plain"].run
    drawn = error["series"][0]["values"]
    assert len(drawn) == len(data["time"])
    assert (max(drawn), min(drawn)) == pytest.approx((run["error.y"].max(), run["error.y"].min()), rel=1e-4)


def test_hard_limits_are_in_the_charts_of_what_they_limit(tmp_path):
    """A limited state that nobody judges has a chart of its own; a price is no limit, and an error and a free input have none."""
    limits = fp.Limits(inputs={"u": (-20.0, math.inf)}, states={"y": (-9.0, 9.0), "y'": (-4.0, 5.0)}, prices={"y": 1.0})
    fp.write_report(compared("plain", limits=limits), tmp_path / "limited.html")
    charts = {c["title"]: c for c in data_of((tmp_path / "limited.html").read_text(encoding="utf-8"))["charts"]}
    shown = {title: (chart["unit"], chart["limits"]) for title, chart in charts.items() if "limits" in chart}
    assert shown == {"y": ("m", []), "command u": ("N", [-20.0, None]), "y'": ("m/s", [-4.0, 5.0])}


def test_a_controller_has_the_colour_of_its_place_in_the_file(written, tmp_path):
    """Whichever others run, in whatever order; no two have the same one."""
    fp.write_report(compared("exact", "adaptive"), tmp_path / "part.html")
    both = (data_of(path.read_text(encoding="utf-8"))["controllers"] for path in (written, tmp_path / "part.html"))
    whole, part = ({c["name"]: c["color"] for c in some} for some in both)
    assert len({*whole.values()}) == 3
    assert part == {name: whole[name] for name in ("exact", "adaptive")}


def test_page_states_a_policy_that_allows_its_own_scripts_alone(written):
    """Every script is named by its hash, no source elsewhere is allowed, and the policy stands before all scripts."""
    whole = written.read_text(encoding="utf-8")
    [policy] = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', whole)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    scripts = re.findall(r"<script>(.*?)</script>", whole, flags=re.DOTALL)
    hashes = [f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts]
    assert rules["script-src"].split() == hashes
    assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == "'none'"
    assert rules["img-src"] == "data:"
    assert whole.index("Content-Security-Policy") < whole.index("<script")


def test_a_run_that_ends_early_is_told_in_words(comparison, tmp_path):
    """Its numbers are 'none' and its reason is in the verdict; a comparison without a row says so; a folder must be there."""
    entry = comparison["plain"]
    short = replace(entry.run, log=entry.run.log[:300], stop="signal 'x' is not finite at t = 0.3 s")
    ended = replace(entry, run=short, metrics=fp.measure(problem(), short))
    fp.write_report(replace(comparison, entries=(ended, *comparison.entries[1:])), tmp_path / "ended.html")
    page = (tmp_path / "ended.html").read_text(encoding="utf-8")
    assert "does not finish: signal &#39;x&#39; is not finite" in page
    assert "<td class='none'>none</td>" in page
    none = replace(comparison, entries=(), skipped={"x": "because"}, description="  y = x")
    fp.write_report(none, tmp_path / "empty.html")
    empty = (tmp_path / "empty.html").read_text(encoding="utf-8")
    assert ("No controller finished" in empty, "<pre class='about'>y = x</pre>" in empty) == (True, True)
    with pytest.raises(OutputError, match="cannot write the report"):
        fp.write_report(comparison, tmp_path / "missing" / "report.html")


def test_the_plot_of_a_run_names_quantities_units_and_controller():
    """A chart has one unit; a concentration is no position; the name is that of the problem file and not of a class."""
    response = lambda q, u, p: {"c": p.k * u.F - q.c, "T": p.k * u.Q_dot - q.T}  # noqa: E731
    gain = {"k": fp.Parameter(1.0, 1.5, "1")}
    plant = fp.Plant({"c": "mol/s", "T": "K"}, {"F": "l/s", "Q_dot": "kW"}, gain, response, order=1)
    reference = fp.Trajectory(lambda t: {"c": ca.sin(t), "T": 5 * ca.cos(t)})
    one = fp.Problem(plant, reference, {"c": 0.0, "T": 4.0}, period=0.01, duration=0.5)
    loaded = tasks.made(one, {"pump, steady": fp.ComputedTorque(fp.Exponential(rate=6.0))})
    run = fp.simulate(loaded.problem, loaded.controllers["pump, steady"], seed=0, compiled=False)
    labels = [axis.get_ylabel() for axis in run.plot().axes]
    wanted = ["error of c [mol/s]", "error of T [K]", "c [mol/s]", "T [K]", "F [l/s]", "Q_dot [kW]"]
    assert labels == [*wanted, "responses of c [mol/s^2]"]
    assert run.controller == run.plot().get_suptitle() == "pump, steady"
