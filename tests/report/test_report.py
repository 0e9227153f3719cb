"""The report: one file, safe, complete, or not there."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.plants import sine_of_three

import fpirhc as fp
from fpirhc import compare, write_report
from fpirhc.errors import OutputError
from fpirhc.problem_files.problem_file import Task
from fpirhc.report.figures import colours_of
from fpirhc.report.html import INTERVALS, blocks, chart_data, render, whole_numbers
from fpirhc.report.terminal import show
from fpirhc.studies.view import to_json
from fpirhc.summary import written_out

HOSTILE = "<script>alert('x')</script> \"& </script>"


def problem():
    """A linear plant with a wrong model that follows a sine."""
    noise = {"u": fp.Noise(0.01)}
    return replace(sine_of_three(), start={"y": 0.3}, duration=1.0, measure_from=0.0, disturbances=noise)


@pytest.fixture(scope="module")
def comparison():
    """A pair of controllers with and without adaptation."""
    track = fp.Exponential(rate=6.0)
    controllers = {
        "plain": fp.ComputedTorque(track),
        HOSTILE: fp.ComputedTorque(track, fp.Sigmoid(gain=-0.5, scale=5.0)),
    }
    return compare(Task("case", Path("case.py"), HOSTILE, HOSTILE, problem(), controllers), seed=0, compiled=False)


@pytest.fixture(scope="module")
def written(comparison, tmp_path_factory) -> Path:
    """The file of its page."""
    path: Path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(comparison, path)
    return path


@pytest.fixture(scope="module")
def whole(written):
    """Its page."""
    return written.read_text(encoding="utf-8")


def test_report_is_self_contained_and_small(written, whole):
    """It opens offline: nothing is fetched, and everything is inside."""
    assert len(whole) < 3_000_000
    assert not re.search(r"""(src|href)\s*=\s*['"](?!data:)""", whole)
    assert "@import" not in whole
    assert [p.name for p in written.parent.iterdir()] == ["report.html"]


def test_verdict_comes_first_then_table_charts_and_pictures(whole):
    """The order in which a reader asks."""
    marks = ("id='verdict'", "<table>", "<h2>Signals over time", "<h2>Contraction", "<h2>The problem", "<h2>Settings")
    places = [whole.index(mark) for mark in marks]
    assert places == sorted(places)
    assert whole.count("<img alt='") == 1


def test_the_pair_of_the_verdict_has_colours_of_its_own(comparison):
    """The first two, whatever its place; no two rows share one."""
    names = [f"c{k}" for k in range(15)]
    entries = tuple(replace(comparison["plain"], name=name) for name in names)
    first = replace(comparison.findings[0], pair=("c7", "c9"))
    colours = colours_of(replace(comparison, entries=entries, findings=(first, *comparison.findings[1:])))
    assert len(set(colours.values())) == 15
    assert [*colours][:2] == ["c7", "c9"]


def test_equations_and_tables_of_a_description_keep_their_columns():
    """Indented blocks are set as written; the lines of a paragraph flow."""
    text = "A sledge that\nslips,\n\n    m x'' = F - f,\n    z' = x'\n\nand\n\n    rms     x [m]\n    CTC    0.0018\n"
    assert blocks(text) == [
        (False, "A sledge that slips,"),
        (True, "m x'' = F - f,\nz' = x'"),
        (False, "and"),
        (True, "rms     x [m]\nCTC    0.0018"),
    ]
    assert blocks("") == []


def test_data_of_the_charts_is_complete(comparison):
    """Every controller, every signal of a coordinate, and no peak lost."""
    data = chart_data(comparison)
    assert [c["name"] for c in data["controllers"]] == ["plain", HOSTILE]
    error = next(c for c in data["charts"] if c["title"] == "error of y")
    run = comparison["plain"].run
    drawn = error["series"][0]["values"]
    assert len(drawn) == len(data["time"]) == 2 * INTERVALS
    assert max(drawn) == pytest.approx(run["error.y"].max(), rel=1e-4)
    assert min(drawn) == pytest.approx(run["error.y"].min(), rel=1e-4)
    json.dumps(data, allow_nan=False)


def test_run_that_ended_early_is_told_in_words(comparison):
    """Its numbers are 'none', its reason is in the table, and its lines stop."""
    entry = comparison["plain"]
    short = replace(entry.run, log=entry.run.log[:300], stop="signal 'x' is not finite at t = 0.3 s")
    ended = replace(entry, run=short, metrics=fp.measure(problem(), short))
    page = render(replace(comparison, entries=(ended, *comparison.entries[1:])))
    assert "ended early: signal &#39;x&#39; is not finite" in page
    assert "<td class='none'>none</td>" in page


def test_no_column_is_empty(comparison):
    """Where nobody plans there is no column of plans: every column has a number in some row."""
    controllers = comparison.view.tables[0]
    assert all(any(row.cells[k] for row in controllers.rows) for k in range(len(controllers.columns)))


def test_page_terminal_notebook_and_json_say_the_same(comparison, whole, capsys, monkeypatch):
    """Every text of the short table is on the terminal, on the page and in a notebook; JSON has the number behind it."""
    monkeypatch.setenv("COLUMNS", "2000")
    view = comparison.view
    show(view, Path("report.html"), verbose=True)
    printed, notebook = capsys.readouterr().out, comparison._repr_html_()
    for row in view.tables[0].narrow.rows:
        for cell in filter(None, row.cells[1:]):
            assert cell in printed
            assert f">{cell}</td>" in whole
            assert f"<td>{cell}</td>" in notebook
    facts = json.loads(to_json(view.facts))["controllers"]["plain"]["metrics"]
    assert facts["rms_error"]["y"] == comparison["plain"].metrics.rms_error["y"]
    assert f"<td>{written_out(facts['rms_error']['y'])}</td>" in notebook


def test_a_comparison_without_a_row_says_so(comparison):
    empty = replace(comparison, entries=(), skipped={"x": "because"})
    assert "No controller finished" in render(empty)


def test_folder_that_cannot_be_written(comparison, tmp_path, monkeypatch):
    monkeypatch.setattr("fpirhc.report.html.render", lambda _: "a page")
    with pytest.raises(OutputError, match="cannot write the report"):
        write_report(comparison, tmp_path / "missing" / "report.html")


def policy(page: str) -> str:
    """The content security policy of a page."""
    match = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', page)
    assert match
    return match[1]


def test_page_states_a_policy_that_allows_its_own_scripts_alone(whole):
    """Every script is named by its hash, no source elsewhere is allowed, and the policy stands before all scripts."""
    rules = dict(rule.strip().split(" ", 1) for rule in policy(whole).split(";"))
    scripts = re.findall(r"<script>(.*?)</script>", whole, flags=re.DOTALL)
    hashes = [f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts]
    assert rules["script-src"].split() == hashes
    assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == "'none'"
    assert rules["img-src"] == "data:"
    assert "http" not in policy(whole)
    assert whole.index("Content-Security-Policy") < whole.index("<script")


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("from 5.5e-5 to -2 m.", "from <span class='number'>5.5e-5 to</span> <span class='number'>-2 m</span>."),
        ("5 800 times less", "<span class='number'>5 800 times</span> less"),
        ("a < b is 0.52 1/min, x1", "a &lt; b is <span class='number'>0.52 1/min</span>, x1"),
    ],
)
def test_a_line_does_not_end_inside_a_number_or_before_its_unit(text, html):
    """Browsers break a line behind the hyphen of 5.5e-5 and at every space; other text is escaped."""
    assert str(whole_numbers(text)) == html
