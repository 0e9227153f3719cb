"""What is said of a table of runs: medians, pairs, failures, groups and the number that is judged."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers.line import EXACT, line_text
from scipy import stats
from typer.testing import CliRunner

import fpirhc as fp
from fpirhc import study
from fpirhc.cli import app
from fpirhc.errors import FpirhcError
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.comparison.verdict import Outcome
from fpirhc.studies.objective import Objective, objective
from fpirhc.studies.study import VariantStudy, interval, middle, share_interval, summarised
from fpirhc.studies.variants import CasesOf, Draws, Grid

CASES = """
cases = fp.Cases({
    "usual": {},
    "weak": {"exact.b": 0.9, "group": "light"},
    "stiff": {"exact.k": 8.0, "exact.b": 1.2, "group": "heavy"},
    "known": {"known.b": 2.0, "group": "heavy"},
    "far": {"start.y": 1.0, "start.y'": -0.5, "seed": 7},
})
"""
LINE = line_text(
    "period=5e-3, duration=1.5, measure_from=0.5, disturbances={'u': fp.Noise(0.1)}",
    bounds="(0.5, 2.4)",
    more=EXACT + CASES,
)


@pytest.fixture
def task(tmp_path, monkeypatch) -> Task:
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


def table(**errors: list[float | None]) -> pd.DataFrame:
    """Rows of controllers with these errors; None: a run that ended early."""
    return pd.DataFrame(
        {
            "controller": name,
            "variant": str(k),
            "group": "",
            "outcome": "ended early" if e is None else "finished",
            "error": e,
        }
        for name, some in errors.items()
        for k, e in enumerate(some)
    )


def sentences(result: VariantStudy) -> list[str]:
    return [text for text, _ in result.view.sentences]


# --- Statistics -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [6, 25, 60])
def test_intervals_cover_the_median_as_often_as_they_say(count):
    """95 % of the samples of any distribution, of which half lies on either side of the median; below six there is none."""
    random = np.random.default_rng(0)
    ends = [interval(random.lognormal(size=count)) for _ in range(2000)]
    assert 0.94 <= np.mean([low <= 1.0 <= high for low, high in ends]) <= 0.99
    assert all(math.isnan(end) for end in interval(np.arange(5.0)))


def test_medians_know_infinity():
    """An infinite number lies beyond all others, and half-way between the two infinities is zero."""
    assert middle(np.array([1.0, 2.0, math.inf])) == 2.0
    assert middle(np.array([1.0, math.inf, math.inf])) == math.inf
    assert middle(np.array([-math.inf, math.inf])) == 0.0
    assert middle(np.array([3.0, 1.0])) == 2.0


@pytest.mark.parametrize(("count", "total"), [(1, 5), (3, 5), (2, 1000), (999, 1000)])
def test_the_share_of_failures_is_that_of_the_exact_binomial_test(count, total):
    exact = stats.binomtest(count, total).proportion_ci(0.95, "exact")
    assert share_interval(count, total) == pytest.approx((exact.low, exact.high), rel=1e-9)


def test_at_the_ends_the_whole_level_is_on_the_other_side():
    """1 - 0.05^(1/300) of all plants would show a failure in 95 of 100 studies: the rule of three, 3 / 300."""
    assert share_interval(0, 300) == pytest.approx((0.0, 1 - 0.05 ** (1 / 300)))
    assert share_interval(300, 300) == pytest.approx((0.05 ** (1 / 300), 1.0))


def test_differences_are_taken_within_variants():
    """Errors that vary by a factor of 100 between variants, and by one per cent of themselves between controllers."""
    errors = np.geomspace(0.001, 0.1, 41)
    row = summarised(table(A=list(errors), B=list(0.99 * errors)), Objective()).loc["B"]
    assert row.better == row.variants == 41
    assert row.difference == pytest.approx(-0.01 * errors[20])
    assert row.low < row.high < 0
    assert row.worst == pytest.approx(0.099)
    assert row.worst_in == "40"


def test_failures_are_counted_and_are_worse_than_any_error():
    """A controller that fails in most variants has no median; where both fail there is no difference."""
    errors = table(A=[0.1, 0.1, None, 0.1, 0.1, None], B=[0.01, None, None, None, 0.01, None])
    row = summarised(errors, Objective()).loc["B"]
    assert row["median"] == math.inf == row.worst
    assert row.worst_in == "1"
    assert row.failures == 4
    assert row.better == 2
    assert row.difference == 0  # two gains, two ties, two losses


# --- Studies ----------------------------------------------------------------------------------------------------------


def test_a_clear_difference_is_told_and_an_unclear_one_is_not_claimed(task):
    found = study(task, Draws(12, 20.0, 5), compiled=False)
    own = found.table.pivot(index="variant", columns="controller", values="error")
    apart = own["CTC+FPI"] - own["CTC"]
    assert found.summary.difference["CTC+FPI"] == pytest.approx(apart.median())
    assert found.summary["median"].to_dict() == pytest.approx(own.median().to_dict())
    said = dict(found.view.sentences)
    clear = Outcome.BETTER if found.summary.high["CTC+FPI"] < 0 else Outcome.NO_DIFFERENCE
    [text] = [text for text in said if text.startswith("CTC+FPI ")][:1]
    assert said[text] is clear
    assert f"smaller in {(apart < 0).sum()} of 12" in text
    few = study(task, Draws(4, 20.0, 5), compiled=False, controllers=["CTC", "CTC+FPI"])
    assert few.view.sentences[0][1] is None
    assert any(text.startswith("CTC fails in 0 of 12: 0 % to ") for text in said)


def test_failures_of_named_cases_are_no_sample(task):
    """Cases are what they are: a share of others cannot be said."""
    weak = replace(task, problem=replace(task.problem, limits=fp.Limits(inputs={"u": (-0.5, 0.5)})))
    [text] = [t for t in sentences(study(weak, CasesOf(), controllers=["CTC"], compiled=False)) if "fails" in t]
    assert text.startswith("CTC fails in ")
    assert text.endswith(" of 5.")


def test_the_worst_case_has_its_name_everywhere_and_a_command_that_runs_it(task):
    found = study(task, CasesOf(("all",), 3), compiled=False)
    errors = found.table.loc[found.table.controller == "CTC"].set_index("variant")
    worst = errors.error.idxmax()
    assert found.summary.worst_in["CTC"] == worst
    assert found.summary.worst["CTC"] == errors.error.max()
    assert found.view.facts["summary"][0]["worst_in"] == worst
    command = found.view.lists["Worst runs"][0]
    assert command == f"fpirhc run line CTC --case {worst} --seed {errors.seed[worst]}"
    heads = [column.head for column in found.view.tables[0].columns]
    assert heads[:4] == ["controller", "worst error", "in", "failures"]


def test_the_command_of_a_worst_run_makes_it_again(task):
    found = study(task, Draws(6, 20.0, 5), controllers=["CTC", "CTC+FPI"], compiled=False)
    command = found.view.lists["Worst runs"][1].replace("run line", "run line.py").split()[1:]
    assert CliRunner().invoke(app, [*command, "--no-compile", "--out", "out"]).exit_code == 0
    plant = Draws(6, 20.0, 5).of(task)[int(found.summary.worst_in["CTC+FPI"])].problem
    error = fp.measure(plant, fp.load_run("out/CTC_FPI.npz")).rms_error["y"]
    rows = found.table.set_index(["controller", "variant"])
    assert rows.loc[("CTC+FPI", found.summary.worst_in["CTC+FPI"]), "rms_error.y"] == error


def test_groups_are_studies_of_their_own(task):
    everything = study(task, CasesOf(), compiled=False)
    assert list(everything.groups) == ["light", "heavy"]
    heavy = study(task, CasesOf(("heavy",)), compiled=False)
    pd.testing.assert_frame_equal(everything.groups["heavy"], heavy.summary)
    assert [one.title for one in everything.view.tables] == ["line: 5 variants", "group light", "group heavy"]


# --- The figure -------------------------------------------------------------------------------------------------------


def judged_by(task: Task, name: str) -> Task:
    """The task with a number that is better when larger, and one that is better when smaller."""
    figures = (fp.figures.Nadir("state.y"), fp.figures.Total("true_error.y"))
    return replace(task, metrics=[*task.metrics, *figures], headline_metric=name)


def test_a_study_speaks_of_the_headline_metric(task):
    """By hand from the rows: medians, the worst, and who is better; larger is better by the metric."""
    found = study(judged_by(task, "nadir"), CasesOf(), compiled=False)
    own = found.table.pivot(index="variant", columns="controller", values="nadir")
    assert found.summary["median"].to_dict() == pytest.approx(own.median().to_dict())
    assert found.summary.worst.to_dict() == own.min().to_dict()
    assert found.summary.better["CTC+FPI"] == (own["CTC+FPI"] > own["CTC"]).sum()
    assert found.summary.difference["CTC+FPI"] == pytest.approx((own["CTC+FPI"] - own["CTC"]).median())
    shown = dict(zip((c.head for c in found.view.tables[0].columns), found.view.tables[0].rows[0].cells, strict=True))
    assert shown["worst nadir"] == f"{own['CTC'].min():.3g} m"
    assert sentences(found)[0].startswith("CTC+FPI against CTC by nadir: larger in ")


def test_another_headline_needs_no_new_runs(task):
    """Rows hold every metric, so that another number is another reading of them; one of the cost is computed on demand."""
    study(task, Draws(3, 20.0), folder=Path("out"), compiled=False)
    before = Path("out/runs.jsonl").read_bytes()
    again = study(task, Draws(3, 20.0), folder=Path("out"), headline="rms_error.y", compiled=False)
    assert Path("out/runs.jsonl").read_bytes() == before
    assert again.summary["median"]["CTC"] == again.table.loc[again.table.controller == "CTC", "rms_error.y"].median()


def test_the_cost_can_be_judged():
    """It is computed from the log of a run, which a study does only where somebody asks for it."""
    task = fp.load_problem("two_mass")
    short = replace(task, problem=replace(task.problem, duration=0.1, measure_from=0.0))
    found = study(short, Draws(2, 10.0), controllers=["RHC", "CTC"], headline="cost.total", compiled=False)
    for one, row in zip(Draws(2, 10.0).of(short), found.table.itertuples(), strict=False):
        run = fp.simulate(one.problem, task.controllers["RHC"], seed=one.seed, compiled=False)
        assert found.table.loc[row.Index, "cost.total"] == pytest.approx(
            fp.measure(one.problem, run)["cost"]["total"], rel=1e-9
        )


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nadr", "Did you mean 'nadir'"),
        ("rms_error", r"give one: 'rms_error\.NAME'"),
        ("effort.u", "no better direction"),
        ("cost.total", r"needs Problem\(horizon=\.\.\., cost="),
    ],
)
def test_wrong_headlines(name, message, task):
    with pytest.raises(FpirhcError, match=message):
        study(judged_by(task, "nadir"), CasesOf(), headline=name, compiled=False)


def test_a_number_that_no_run_has_is_refused(task):
    task = replace(task, metrics=[*task.metrics, fp.Metric("plans.done", lambda problem, run: None)])
    with pytest.raises(FpirhcError, match=r"metric 'plans\.done': a run of 'CTC' has none"):
        study(task, Draws(1), headline="plans.done", compiled=False)


def test_a_run_that_fails_costs_more_than_any_metric(task):
    """Between one and two penalties, less if it lasted long."""
    aim = objective("max_error.y", task.metrics, task.problem)
    early = {"outcome": "ended early", "controller": "RHC", "error": math.inf, "lasted": 0.25}
    finished = {"outcome": "finished", "controller": "RHC", "error": 0.1, "lasted": 1.0, "max_error.y": 3e5}
    assert aim.cost(finished) == 3e5
    assert 3e5 < aim.cost({**early, "lasted": 0.75}) < aim.cost(early) < math.inf


# --- The command ------------------------------------------------------------------------------------------------------


def test_the_best_cell_of_a_grid_is_told(task):
    found = study(task, Grid.parsed(["deformation.gain=-1:-0.2:5"]), controllers=["CTC", "CTC+FPI"], compiled=False)
    own = found.table.loc[found.table.controller == "CTC+FPI"].set_index("variant")
    [text] = [t for t in sentences(found) if "the smallest error is" in t]
    assert text.endswith(f"at {own.error.idxmin()}.")
    assert text.startswith("CTC+FPI: ")


@pytest.mark.parametrize(
    "words",
    [
        ["--draws", "3", "--mismatch", "20%"],
        ["--cases", "heavy", "far"],
        ["--over", "deformation.gain=-1:-0.2:3"],
        ["--over", "deformation.gain=-1:-0.2:3", "exact.b=1:2:2"],
        ["--limits", "mismatch", "lost"],
    ],
    ids=" ".join,
)
def test_the_command_writes_a_page_and_a_table(words, task):
    done = CliRunner().invoke(app, ["study", "line.py", *words, "--no-compile", "--json", "--out", "out"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["versions"]["fpirhc"]
    assert "<html" in Path("out/report.html").read_text()
    read = pd.read_csv("out/study.csv")
    if words[0] != "--limits":
        assert "rms_error.y [m]" in read
        assert len(read) == 3 * {"--draws": 3, "--cases": 3}.get(
            words[0], 3 ** (len(words) == 2) * 6 ** (len(words) == 3)
        )


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--draws", "3", "--cases", "all"],
        ["--cases", "all", "--mismatch", "20%"],
        ["--limits", "lost", "--headline", "rms_error.y"],
        ["--draws", "-1"],
    ],
    ids=" ".join,
)
def test_options_without_effect_are_refused(words, task):
    assert CliRunner().invoke(app, ["study", "line.py", *words]).exit_code == 2
