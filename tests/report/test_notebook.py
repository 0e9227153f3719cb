"""Results show themselves, and names that a user chose are shown as they are, wherever they are shown."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.problem_files.problem_file import Task
from fpirhc.report import terminal
from fpirhc.report.html import render
from fpirhc.report.terminal import progress_bars, show, show_run
from fpirhc.review.question import Answer, Review, Verdict
from fpirhc.studies.comparison.comparison import Comparison
from fpirhc.studies.objective import Objective
from fpirhc.studies.scenarios.scenario_study import compare_scenarios
from fpirhc.summary import printable, table

HOSTILE = "<img src=x onerror=alert(1)>[bold red]$\\frac$ \x1b[31m:bomb: `id` $(id) \"'&"
MARKED = "[bold]plain[/bold]\\[/x]"
UNIT = "</script><b>m[/]$"


def hostile_problem(duration: float = 0.3) -> fp.Problem:
    """A mass whose units, parameter and cost term have names that a page, a shell or a terminal would obey."""
    plant = fp.Plant(
        coordinates={"y": UNIT},
        inputs={"u": "N<i>"},
        parameters={
            "<b>": fp.Parameter(approximate=1.0, exact=1.6, unit="<u>"),
            "k": fp.Parameter(approximate=2.0, exact=5.0, unit="1/s^2"),
        },
        response=lambda q, v, u, p: {"y": p["<b>"] * u.u - p.k * q.y - 0.2 * v.y},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}),
        start={"y": 0.5},
        period=5e-3,
        duration=duration,
        limits=fp.Limits(inputs={"u": (-30.0, 30.0)}),
        horizon=fp.Horizon(stages=4, step=1e-2),
        cost=fp.CustomCost(lambda s: {"<s>cost</s>[/]": 100 * (s.state.y - s.reference.y) ** 2 + 1e-2 * s.input.u**2}),
    )


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    """A pair with hostile names, a controller that ends early, and one that is skipped."""
    tracking = fp.Exponential(rate=6.0)
    planner = fp.FixedPoint(iterations=1, tolerance=1e-3)
    controllers = {
        MARKED: fp.ComputedTorque(tracking),
        HOSTILE: fp.ComputedTorque(tracking, fp.Sigmoid(gain=-0.5, scale=50.0)),
        "RHC [/]": fp.RecedingHorizon(planner),
        "skipped <b>[/b]": fp.Predicted(fp.Predicted(fp.ComputedTorque(tracking), inputs=0.01), inputs=0.01),
    }
    task = Task("[bold]<i>", Path("x.py"), HOSTILE, HOSTILE, hostile_problem(), controllers, (MARKED, HOSTILE))
    return fp.compare(task, seed=0, compiled=False, command="fpirhc compare '<b>'")


@pytest.fixture(scope="module")
def plan() -> fp.Plan:
    problem = hostile_problem()
    assert problem.horizon is not None
    assert problem.cost is not None
    values = problem.plant, problem.reference, problem.horizon, problem.cost
    limits = fp.Limits(states={"y": (0.9, 1.0)}, inputs={"u": (-1.0, 1.0)})
    data = np.asarray(stage_data(*values)(0.0, problem.plant.approximate).full())
    return fp.solve(
        transcribe(*values, limits), fp.FixedPoint(iterations=5, tolerance=1e-3), np.array([0.5, 0.0]), data
    )


class Tags(HTMLParser):
    """Tags of a page, and the text between them."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data):
        self.text += data


def read(page: str) -> Tags:
    parser = Tags()
    parser.feed(page)
    return parser


def shown(comparison: Comparison, plan: fp.Plan) -> dict[str, Any]:
    entry = comparison[HOSTILE]
    assert entry.contraction is not None
    return {
        "comparison": comparison,
        "run": entry.run,
        "metrics": entry.metrics,
        "contraction": entry.contraction.report,
        "plan": plan,
        "certificate": fp.certify(plan),
    }


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> dict[str, Any]:
    """What a user works with: a task with its problem and plant, a review of it, and scenarios."""
    folder = tmp_path_factory.mktemp("inputs")
    tracking = fp.Exponential(rate=6.0)
    controllers = {
        MARKED: fp.ComputedTorque(tracking),
        HOSTILE: fp.ComputedTorque(tracking, fp.Sigmoid(gain=-0.5, scale=50.0)),
    }
    task = Task("[bold]<i>", Path(__file__), HOSTILE, HOSTILE, hostile_problem(0.05), controllers, (MARKED, HOSTILE))
    answer = Answer(f"Is it {HOSTILE}?", Verdict.NO, f"{HOSTILE} is 3 {UNIT}", "change it")
    study = compare_scenarios(task, count=2, percent=5.0, seed=0, folder=folder, compiled=False)
    review = Review((answer,), {HOSTILE: (answer, replace(answer, verdict=Verdict.YES, change=""))}, 5.0)
    plant = task.problem.plant
    return {"task": task, "problem": task.problem, "plant": plant, "review": review, "scenarios": study}


@pytest.mark.parametrize("kind", ["task", "problem", "plant", "review", "scenarios"])
def test_inputs_show_themselves_as_results_do(kind, inputs):
    """A line and a table of nothing but text, whatever the names are."""
    check_shows_itself(inputs[kind])


def test_inputs_show_what_they_hold(inputs):
    """Units, parameters, times, limits, kinds of controllers, answers and medians, each in its table."""
    texts = {kind: read(value._repr_html_()).text for kind, value in inputs.items()}
    for text in (UNIT, "coordinate, order 2", "1.6", "1/s^2", "Unit of time: s."):
        assert text in texts["plant"]
    for text in ("10 cycles of 0.005 s, 0.05 s in all", "-30 to 30 N<i>", "4 stages of 0.01 s", "y = 0.5, y' = 0"):
        assert text in texts["problem"]
    for text in (printable(HOSTILE), "ComputedTorque", "Sigmoid", "with adaptation", "10 cycles"):
        assert text in texts["task"]
    for text in ("not ready", "change it", "1 yes, 0 caution, 2 no, 0 unknown"):
        assert text in texts["review"]
    study = inputs["scenarios"]
    for text in ("baseline", Objective().text(study.summaries[1].median), printable(study.verdict[0])):
        assert text in texts["scenarios"]


KINDS = ("comparison", "run", "metrics", "contraction", "plan", "certificate")


@pytest.mark.parametrize("kind", KINDS)
def test_results_show_themselves(kind, comparison, plan):
    """A line that names the class, and a table of nothing but text."""
    check_shows_itself(shown(comparison, plan)[kind])


def check_shows_itself(value: Any) -> None:
    """A line without new lines and escape codes, and a page without tags that come from a name."""
    line, page = repr(value), read(value._repr_html_())
    assert line.startswith(f"{type(value).__name__}(")
    assert "\n" not in line
    assert len(line) < 1000
    assert "array(" not in line
    assert str(value) == line
    assert "\x1b" not in line + page.text
    assert page.tags <= {"div", "table", "caption", "tr", "th", "td", "p"}
    assert not page.attributes


def test_what_is_shown_is_what_was_found(comparison, plan):
    result = {kind: read(value._repr_html_()).text for kind, value in shown(comparison, plan).items()}
    rms = f"{comparison[HOSTILE].metrics.rms_error['y']:.4g}"
    assert comparison[HOSTILE].metrics.text("rms_error", "y") in result["comparison"]
    assert rms in result["metrics"]
    assert MARKED in result["comparison"]
    assert printable(HOSTILE) in result["comparison"]
    assert printable(comparison.verdict[0]) in result["comparison"]
    assert UNIT in result["run"]
    assert f"{comparison[HOSTILE].run['command.u'].max():.4g}" in result["run"]
    assert comparison[HOSTILE].contraction.report.text in result["contraction"]
    assert "below 0.9, at stage 0" in result["plan"]
    assert plan.status.name in repr(plan)


def test_an_empty_run_shows_itself(comparison):
    """A run that ended in its first cycle has no extremes, but a reason."""
    run = replace(comparison[MARKED].run, log=comparison[MARKED].run.log[:0], stop="signal <b> is not finite")
    assert "0 cycles" in repr(run)
    assert "ended early: signal <b> is not finite" in read(run._repr_html_()).text


def test_plots_are_pictures_and_open_no_window(comparison):
    """A figure gives its own picture; pyplot, which would keep it and choose a back end, is not even imported."""
    figure = comparison[HOSTILE].run.plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert figure.canvas.manager is None
    code = (
        "import sys, casadi, fpirhc as fp\n"
        "p = fp.load_problem('van_der_pol').problem\n"
        "from dataclasses import replace\n"
        "p = replace(p, duration=0.02, measure_from=0.0)\n"
        "r = fp.simulate(p, fp.ComputedTorque(fp.Exponential(rate=6.0)), seed=0, compiled=False)\n"
        "r.plot()._repr_png_(); r._repr_html_()\n"
        "print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "False"


def test_report_holds_no_foreign_tags(comparison):
    """No tag or handler comes from a name, no script ends early, and the names are in the text."""
    page = render(comparison)
    parsed = read(page)
    assert not {"i", "u", "s", "img "} & parsed.tags
    assert "onerror" not in parsed.attributes
    assert "<b>m[/]" not in page
    assert page.count("<img ") == page.count("<img alt=")
    assert page.count("</script>") == page.count("<script>") == 4
    assert MARKED in parsed.text
    assert "skipped <b>[/b]" in parsed.text


def test_figures_show_names_literally(comparison):
    """Dollar signs are no formula: one that is wrong would end the report."""
    figure = comparison[HOSTILE].run.plot()
    figure.savefig("/dev/null", format="png", dpi=30)
    title = figure.get_suptitle()
    assert title.replace("\\$", "$") == printable(HOSTILE)
    assert "\x1b" not in title


def test_terminal_shows_names_literally(comparison, capsys, monkeypatch):
    """No markup, no emoji, no escape codes: what was written is what is read."""
    monkeypatch.setenv("COLUMNS", "4000")
    show(comparison.view, Path("[bold]report.html"))
    printed = capsys.readouterr().out
    for name in (
        MARKED,
        printable(HOSTILE),
        "RHC [/]",
        "skipped skipped <b>[/b]",
        "[bold]<i>, from",
        f"rms y [{UNIT}]",
    ):
        assert name in printed
    assert "report: [bold]report.html" in printed
    assert "\x1b[31m" not in printed
    show_run(comparison[HOSTILE].run, comparison[HOSTILE].metrics, ["[/]harm"], [Path("[/]run.npz")])
    assert UNIT in capsys.readouterr().out
    with progress_bars() as report:
        report(HOSTILE, 1, 2)
    assert "\x1b[31m:bomb:" not in capsys.readouterr().err
    with progress_bars():
        pass  # an error before the first run leaves no line of bars
    assert capsys.readouterr().err == ""


def test_tables_escape_every_part():
    page = table("<a>", ("<b>",), [("<c>", "<d>")], ["<e>"])
    assert read(page).tags == {"div", "table", "caption", "tr", "th", "td", "p"}
    assert read(page).text == "<a><b><c><d><e>"


def test_progress_for_programs_is_a_line_of_json(monkeypatch, capsys):
    """What was finished before, and the time until the first answer, count for no rate; the last line has everything."""
    clock = iter([0.0, 10.0, 10.5, 12.5, 13.0])
    monkeypatch.setattr(terminal, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with progress_bars(as_json=True) as report:
        for done in (10, 20, 40, 100):
            report("RHC", done, 100)
    first, second, last = map(json.loads, capsys.readouterr().err.splitlines())
    assert first == {"controller": "RHC", "done": 10, "of": 100, "per second": None, "seconds left": None}
    assert second == {"controller": "RHC", "done": 40, "of": 100, "per second": 10.0, "seconds left": 6.0}
    assert last == {"controller": "RHC", "done": 100, "of": 100, "per second": 32.0, "seconds left": 0.0}
