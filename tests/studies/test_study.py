"""Studies: a variant is a problem, its row is a run, and what is said of the table follows from the table."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from helpers.line import EXACT, line_text
from scipy import stats

import fpirhc as fp
from fpirhc.__main__ import main
from fpirhc.errors import FpirhcError, InvalidField, InvalidProblem

CASES = """
cases = fp.Cases({
    "usual": {},
    "weak": {"exact.b": 0.9, "group": "light"},
    "stiff": {"exact.k": 8.0, "exact.b": 1.2, "group": "heavy"},
    "known": {"exact.b": 2.0, "approximate.b": 2.0, "group": "heavy"},
    "far": {"start.y": 1.0, "start.y'": -0.5},
})
"""
LINE = line_text(
    "period=5e-3, duration=1.5, measure_from=0.5, disturbances={'u': fp.Noise(0.1)}",
    bounds="(0.5, 2.4)",
    more=EXACT + CASES,
)


@pytest.fixture
def task(tmp_path, monkeypatch) -> Any:
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


def rows(task: Any, variants: Any, **settings: Any) -> pd.DataFrame:
    return fp.study(task, variants, compiled=False, **settings).table


def error(problem: fp.Problem, controller: Any, seed: int) -> float:
    return fp.measure(problem, fp.simulate(problem, controller, seed=seed, compiled=False)).rms_error["y"]


def sentences(result: Any) -> list[str]:
    return [text for text, _ in result.view.sentences]


def test_a_study_measures_what_rests_by_its_limits(task):
    """By their distance, where no cost weighs it."""
    limits = replace(task.problem.limits, states={"y": (-2e-4, 3e-4)})
    problem = replace(task.problem, reference=fp.Trajectory(lambda t: {"y": 0 * t}), start={"y": 0.0}, limits=limits)
    table = rows(replace(task, problem=problem), fp.CasesOf(("usual",)))
    errors = [error(problem, controller, int(table.seed[0])) for controller in task.controllers.values()]
    assert table.error.min() == pytest.approx(min(errors) / 5e-4)


# --- Variants ---------------------------------------------------------------------------------------------------------


def drawn(task: Any, count: int = 8, percent: float = 20.0, seed: int = 3) -> list[tuple[int, tuple[float, ...]]]:
    """Seed of the noise and exact parameters of some drawn plants."""
    plants = fp.Draws(count, percent, seed).of(task)
    return [(one.seed, tuple(one.problem.plant.exact.tolist())) for one in plants]


def test_a_drawn_plant_is_its_number(task):
    """Whatever the number of plants; another number or seed is another one, and a wider range the same share of it."""
    some, more, other = drawn(task), drawn(task, 20), drawn(task, seed=4)
    assert more[:8] == some
    assert not {*some} & {*other}
    assert len({seed for seed, _ in more}) == len({exact for _, exact in more}) == 20
    assert [seed for seed, _ in drawn(task, percent=10.0)] == [seed for seed, _ in some]
    assert all(one.problem is task.problem for one in fp.Draws(3).of(task))  # noise alone
    alone = "3 plants of seed 0, which differ in noise and stated spreads alone (--mismatch P draws parameters too)"
    assert str(fp.Draws(3)) == alone


def test_factors_are_log_uniform():
    """Logarithms of the factors are uniform between those of 0.6 and 1.4; signs and zeros stay."""
    values = {"a": 3.0, "b": -2.0, "zero": 0.0}
    known, moves = (
        {n: fp.Parameter(v, v, "1") for n, v in values.items()},
        lambda q, v, u, p: {"y": u.u + p.a * q.y + p.b * v.y},
    )
    plant = fp.Plant({"y": "m"}, {"u": "N"}, known, moves)
    rest = fp.Trajectory(lambda t: {"y": 0 * t})
    problem = fp.Problem(plant=plant, reference=rest, start={"y": 0.0}, period=1e-2, duration=1.0)
    exact = np.array([one.problem.plant.exact for one in fp.Draws(1500, 40.0).of_problem(problem)])
    assert np.all(exact[:, 2] == 0)
    low, high = math.log(0.6), math.log(1.4)
    for column, value in ((0, 3.0), (1, -2.0)):
        logarithms = np.log(exact[:, column] / value)
        assert low <= logarithms.min() < low + 0.01
        assert high - 0.01 < logarithms.max() <= high
        assert stats.kstest(logarithms, stats.uniform(low, high - low).cdf).pvalue > 0.01


@pytest.mark.parametrize(
    ("late", "times"),
    [(fp.DeadTime(), {0}), (fp.DeadTime(measurement=0.01), {1, 2, 3}), (fp.DeadTime(inputs={"u": 0.02}), {3, 4, 5})],
    ids=str,
)
def test_the_row_of_a_drawn_plant_is_the_run_of_a_fresh_loop(late, times, task):
    """Bit by bit, for every controller; dead times are drawn in whole cycles, one seed and one plant for all."""
    task = replace(task, problem=replace(task.problem, dead_time=late))
    draws, found = fp.Draws(10, 20.0, 5), set()
    table = rows(task, draws)
    alone = table.loc[table.controller == "CTC+FPI"].reset_index(drop=True)
    pd.testing.assert_frame_equal(rows(task, draws, controllers=["CTC+FPI"]), alone)
    for one in draws.of(task):
        now = one.problem.dead_time
        found.add(round((now.measurement or now.inputs.get("u", 0.0)) / one.problem.period))
        run = fp.simulate(one.problem, task.controllers["CTC"], seed=one.seed, compiled=False)
        row = table.set_index(["controller", "variant"]).loc["CTC", one.name]
        assert row["rms_error.y"] == fp.measure(one.problem, run).rms_error["y"]
        assert row.seed == one.seed
        assert row[["exact.b", "exact.k"]].tolist() == one.problem.plant.exact.tolist()
        assert row.get("dead_time.inputs.u", 0.0) == now.inputs.get("u", 0.0)
    assert found == times
    assert ("dead_time.measurement" in table) == (times != {0})


def test_a_case_changes_what_it_states_and_nothing_else(task):
    """Parameters of either set, the start, inner numbers, a whole field; of a reality its own parameters."""
    more = {
        "late": {"dead_time.measurement": 0.01},
        "narrow": {"limits.inputs.u.1": 4.0, "limits.inputs.u.0": -4.0},
        "other way": {"reference": fp.Trajectory(lambda t: {"y": 0.3 + 0 * t}), "start.y": 0.3},
    }
    limits = fp.Limits(inputs={"u": (-40.0, 40.0)})
    plain, cases = replace(task.problem, limits=limits), fp.Cases({**task.cases.changes, **more})
    of = {name: cases.problem(name, plain) for name in cases.names}
    assert [of["stiff"].plant.exact.tolist(), of["stiff"].plant.approximate.tolist()] == [[1.2, 8.0], [1.0, 2.0]]
    assert [of["known"].plant.exact.tolist(), of["known"].plant.approximate.tolist()] == [[2.0, 5.0], [2.0, 2.0]]
    assert of["far"].start_state.tolist() == [1.0, -0.5]
    assert of["late"].dead_time.measurement == 0.01
    assert of["narrow"].limits.inputs["u"] == (-4.0, 4.0)
    assert of["other way"].reference is not plain.reference
    assert np.array_equal(of["usual"].plant.exact, plain.plant.exact)
    assert plain.start_state.tolist() == [0.5, 0.0]
    real = replace(plain.plant, parameters={**plain.plant.parameters, "drag": fp.Parameter(0.0, 0.0, "1/s")})
    moved = fp.Cases({"drag": {"exact.drag": 0.4, "exact.b": 1.1, "approximate.b": 1.1}}).problem(
        "drag", replace(plain, reality=fp.Reality(real))
    )
    assert moved.real_plant.exact.tolist() == [1.1, 5.0, 0.4]
    assert moved.plant.approximate.tolist() == [1.1, 2.0]


def test_cases_are_their_problems(task):
    """The run of a case is that of its problem; its seed follows from its place among all cases."""
    table = rows(task, fp.CasesOf(("all",), 2), controllers=["CTC"]).set_index("variant")
    assert list(table.index) == ["usual", "weak", "stiff", "known", "far"]
    for name, row in table.iterrows():
        problem = task.cases.problem(name, task.problem)
        assert row["rms_error.y"] == error(problem, task.controllers["CTC"], row.seed)
    heavy = rows(task, fp.CasesOf(("heavy",), 2), controllers=["CTC"])
    assert heavy.variant.tolist() == ["stiff", "known"]
    assert heavy.seed[1] == table.seed["known"] != table.seed["usual"]
    assert table["exact.k"].tolist() == [5.0, 5.0, 8.0, 5.0, 5.0]
    assert table["start.y'"].tolist() == [0.0, 0.0, 0.0, 0.0, -0.5]
    assert table["approximate.b"].tolist() == [1.0, 1.0, 1.0, 2.0, 1.0]
    assert table.group.tolist() == ["", "light", "heavy", "heavy", ""]


def test_a_cell_of_a_grid_is_the_run_with_its_numbers(task):
    """Settings of controllers and of the problem, live or built anew; a refused gain is a row."""
    grid = fp.Grid.parsed(["deformation.gain=-0.8:-0.2:3", "exact.b=0.8:1.6:2:log"], seed=1)
    table = rows(task, grid)
    assert table.attrs["units"]["exact.b"] == "1/kg"
    for row in table.itertuples():
        gain, b = table.loc[row.Index, ["deformation.gain", "exact.b"]]
        controller = task.controllers[row.controller]
        own = fp.with_settings(controller, {"deformation.gain": gain}) if row.controller == "CTC+FPI" else controller
        expected = error(task.problem.with_exact(np.array([b, 5.0])), own, 1)
        assert table.loc[row.Index, "rms_error.y"] == pytest.approx(expected, rel=1e-12)
    assert rows(task, fp.Grid.parsed(["period=5e-3:1e-2:2"]), controllers=["CTC"])["cycles"].tolist() == [300, 150]
    grid, both = fp.Grid.parsed(["deformation.gain=-0.5:0.5:3"]), ["CTC", "CTC+FPI"]
    refused = fp.study(task, grid, controllers=both, compiled=False)
    assert (refused.table.outcome.tolist()[3::2], "gain" in refused.table.why[5]) == (["finished", "refused"], True)
    assert [refused.view.tables[0].rows[1].cells[k] for k in (1, 4, 5)] == ["lost"] * 3  # worst, median, difference
    turned = fp.study(task, grid, controllers=both[::-1], compiled=False)
    assert turned.view.tables[0].rows[1].cells[5] == "other lost"


def of_case(changes: Any) -> Any:
    return lambda t: fp.Cases({"weak": changes}).problem("weak", t.problem)


WRONG: dict[str, tuple[Any, str]] = {
    "one value": (lambda t: fp.Grid.parsed(["deformation.gain=-1:-0.1:1"]), "at least 2 values"),
    "log across zero": (lambda t: fp.Grid.parsed(["deformation.gain=-1:1:5:log"]), "one sign"),
    "a path twice": (lambda t: fp.Grid.parsed(["tracking.rate=1:2:3"] * 2), "twice"),
    "three axes": (lambda t: fp.Grid.parsed([f"{n}=1:2:3" for n in "abc"]), "one or two"),
    "a misspelt parameter": (lambda t: fp.Grid.parsed(["exact.c=1:2:5"]).of(t), "Valid: b, k"),
    "an unknown case": (lambda t: fp.CasesOf(("haevy",)).of(t), "Did you mean 'heavy'"),
    "one plant many times": (
        lambda t: fp.Draws(3).of(replace(t, problem=replace(t.problem, disturbances={}))),
        "would be the same: .* give --mismatch P",
    ),
    "no case": (lambda t: fp.Cases({}), "there is none; expected "),
    "the name of all": (lambda t: fp.Cases({"all": {}}), "'all' means every case"),
    "a group that is no text": (lambda t: fp.Cases({"weak": {"group": 1}}), "case 'weak': 'group' is a text, got 1"),
    "a parameter that is not there": (of_case({"exact.c": 1.0}), r"'exact\.c': .* is called 'c'\. .*Valid: b, k"),
    "a parameter alone": (of_case({"b": 1.0}), r"Write 'exact\.b' \(parameter of what moves\) or 'approximate\.b'"),
    "a field that is misspelt": (of_case({"dead_tme.measurement": 0.1}), r"'dead_tme.*Did you mean 'dead_time'\?"),
    "outside its bounds": (of_case({"exact.b": -70.0}), r"'exact\.b': expected 0\.5 to 2\.4 1/kg, got -70"),
    "no number": (of_case({"exact.b": "1.2"}), r"'exact\.b': expected a finite number, got the text '1\.2'"),
    "a misspelt metric": (lambda t: rows(t, fp.Draws(1), metric="rms_eror.y"), "Did you mean 'rms_error.y'"),
    "a metric without a better": (lambda t: rows(t, fp.Draws(1), metric="effort.u"), "no better direction"),
    "a metric of plans": (lambda t: rows(t, fp.Draws(1), metric="cost.total"), r"needs Problem\(horizon="),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_named(wrong, task):
    make, message = WRONG[wrong]
    with pytest.raises(FpirhcError, match=message):
        make(task)


def test_all_wrong_cases_are_told_at_once(task):
    """Where a file is read; one that is asked for tells its own."""
    cases = {name: {"exact.c": 1.0, "exact.b": b} for name, b in {"weak": 9.0, "stiff": -1.0, "far": 1.0}.items()}
    with pytest.raises(InvalidProblem) as told:
        fp.Cases({**cases, "right": {}}).check(task.problem)
    assert [str(told.value).count(f"case '{name}'") for name in cases] == [2, 2, 1]
    assert fp.Cases({**cases, "right": {}}).problem("right", task.problem).plant is task.problem.plant
    name: Any = "right"
    with pytest.raises(InvalidField, match="the values of 'name' and 'problem' are swapped"):
        fp.Cases(cases).problem(task.problem, name)


# --- What is said of a table ------------------------------------------------------------------------------------------


def test_a_summary_is_that_of_the_rows(task):
    """Medians, paired differences, failures, worst runs; a clear difference is told, an unclear one is not claimed."""
    found = fp.study(task, fp.Draws(12, 20.0, 5), compiled=False)
    own = found.table.pivot(index="variant", columns="controller", values="error")
    alone = fp.study(task, fp.Draws(1, 20.0, 5), controllers=[found.summary.index[0]], compiled=False)
    heads = [[one.head for one in shown.view.tables[0].columns if "against" in one.head] for shown in (found, alone)]
    assert list(map(len, heads)) == [1, 0]
    apart = own["CTC+FPI"] - own["CTC"]
    assert found.summary.difference["CTC+FPI"] == pytest.approx(apart.median())
    assert found.summary["median"].to_dict() == pytest.approx(own.median().to_dict())
    assert found.summary.better["CTC+FPI"] == (apart < 0).sum()
    moves = found.table.groupby("controller")["total_variation.u"].median()
    assert found.summary["total_variation.u"].to_dict() == moves.to_dict()
    assert f"{moves['CTC']:.3g}" in found.view.tables[0].rows[0].cells
    # Of 12 differences the third and the tenth bound the median with 96 % (the binomial distribution of signs).
    assert found.summary.loc["CTC+FPI", ["low", "high"]].tolist() == pytest.approx(sorted(apart)[2:10:7], rel=1e-12)
    [(text, outcome)] = [(t, o) for t, o in found.view.sentences if t.startswith("CTC+FPI ")][:1]
    assert (str(outcome) == "better") == (found.summary.high["CTC+FPI"] < 0)
    told = f"The total variation of u is {moves['CTC+FPI']:.3g} N/s, with CTC {moves['CTC']:.3g} N/s."
    before, after = (f"{100 * own[name].median():.3g} %" for name in ("CTC", "CTC+FPI"))
    told = f"smaller in {(apart < 0).sum()} of 12 variants; the median is {after}, with CTC {before}. {told}"
    assert text.endswith(told)
    turned = ["CTC+FPI", "CTC"]
    few = fp.study(task, fp.Draws(4, 20.0, 5), compiled=False, controllers=turned)
    assert "CTC has a smaller error than CTC+FPI in 0 of 4 variants; the" in few.view.sentences[0][0]  # it moves less
    mine = fp.Metric("largest", lambda problem, run: float(abs(run["command.u"]).max()), unit="N", main=True)
    own = replace(task, headline=("CTC+FPI", "CTC"), metrics=[*task.metrics, mine])
    headed = fp.study(own, fp.Draws(1), compiled=False)
    assert [*headed.summary.index][:2] == turned
    assert headed.view.tables[0].columns[-2].head == "largest [N]"  # a main metric of the file is in the table
    assert headed.summary.largest.to_dict() == headed.table.set_index("controller").largest.to_dict()
    # Failures are worse than any error; of named cases, which are no sample, no share of others is said.
    most = 100 * (1 - 0.05 ** (1 / 12))  # about the rule of three, 3 / 12
    told = f"fail in 0 of 12 variants: of all plants drawn so 0 % to {most:.3g} % fail, with 95 % confidence."
    assert f"CTC, CTC+FPI, CTC exact {told}" in sentences(found)
    narrow = replace(task, problem=replace(task.problem, limits=fp.Limits(inputs={"u": (-0.5, 0.5)})))
    lost = fp.study(narrow, fp.CasesOf(), controllers=["CTC"], compiled=False)
    failed = lost.table.loc[lost.table.outcome != "finished"]
    assert lost.summary.failures["CTC"] == len(failed) > 0
    first = failed.iloc[0]
    told = f"CTC fails in {len(failed)} of 5 variants. The first is variant {first.variant}: {first.outcome}"
    assert told in "\n".join(sentences(lost))
    # The command of a worst run makes it again.
    [command] = [one for one in found.view.lists["Worst runs"] if "CTC+FPI" in one]
    assert main([*command.replace("run line", "run line.py").split()[1:], "--no-compile", "--out", "out"]) == 0
    worst = found.summary.worst_in["CTC+FPI"]
    plant = fp.Draws(12, 20.0, 5).of(task)[int(worst)].problem
    again = fp.measure(plant, fp.load_run("out/CTC_FPI.npz")).rms_error["y"]
    assert found.table.set_index(["controller", "variant"]).loc[("CTC+FPI", worst), "rms_error.y"] == again


def test_chatter_in_some_plants_makes_a_study_doubtful(task):
    """Near the limit of its gain the command goes to and fro in some plants: less error in all of them is no success yet."""
    eager = fp.with_settings(task.controllers["CTC+FPI"], {"deformation.gain": -2.4})
    own = {"CTC": task.controllers["CTC"], "CTC+FPI": eager}
    problem = replace(task.problem, disturbances={"u": fp.Noise(1e-3)})
    found = fp.study(replace(task, problem=problem, controllers=own), fp.Draws(12, 20.0, 5), compiled=False)
    moved = found.table.pivot(index="variant", columns="controller", values="total_variation.u")
    times = moved["CTC+FPI"] / moved["CTC"]
    assert found.chatter == {"CTC+FPI": times[times > 10].to_dict()}
    [(text, outcome), *_] = found.view.sentences
    assert (str(outcome), found.summary.better["CTC+FPI"]) == ("doubtful", 12)
    assert f"It chatters in {(times > 10).sum()} variants ({times.idxmax()}, " in text
    [(text, outcome), *_] = replace(found, summary=found.summary.assign(failures=[1, 3])).view.sentences
    told = "CTC+FPI has mixed results beside CTC: it fails in 3 variants, CTC in 1; its error is smaller in 12 of 12 variants"
    assert (str(outcome), text.partition(";")[0]) == ("mixed", told.partition(";")[0])


def test_a_study_speaks_of_the_headline_metric(task):
    """By hand from the rows, larger is better by the metric; another metric is another reading of the same rows."""
    own_metrics = [*task.metrics, fp.figures.Nadir("state.y")]
    task = replace(task, metrics=own_metrics, headline_metric="nadir")
    found = fp.study(task, fp.CasesOf(), folder=Path("out"), compiled=False)
    own = found.table.pivot(index="variant", columns="controller", values="nadir")
    assert found.summary["median"].to_dict() == pytest.approx(own.median().to_dict())
    assert found.summary.worst.to_dict() == own.min().to_dict()
    assert found.summary.better["CTC+FPI"] == (own["CTC+FPI"] > own["CTC"]).sum()
    assert sentences(found)[0].startswith("CTC+FPI has a larger nadir than CTC in ")
    before = Path("out/runs.jsonl").read_bytes()
    again = fp.study(task, fp.CasesOf(), folder=Path("out"), metric="rms_error.y", compiled=False)
    assert Path("out/runs.jsonl").read_bytes() == before
    assert again.summary["median"]["CTC"] == again.table.loc[again.table.controller == "CTC", "rms_error.y"].median()


def test_the_cost_can_be_judged():
    """It is computed from the log of a run, which a study does only where somebody asks for it."""
    task = fp.load_problem("two_mass")
    short = replace(task, problem=replace(task.problem, duration=0.1, measure_from=0.0))
    table = rows(short, fp.Draws(2, 10.0), controllers=["RHC", "CTC"], metric="cost.total")
    for one, cost in zip(fp.Draws(2, 10.0).of(short), table["cost.total"], strict=False):
        run = fp.simulate(one.problem, task.controllers["RHC"], seed=one.seed, compiled=False)
        assert cost == pytest.approx(fp.measure(one.problem, run)["cost"]["total"], rel=1e-9)


@pytest.mark.parametrize(
    ("words", "count", "scales"),
    [
        ("--cases heavy far", 9, []),
        ("--over deformation.gain=-1:-0.2:3 exact.b=1:2:2", 18, []),
        ("--over exact.b=1:2:3:log", 9, ["log"]),
        ("--over deformation.gain=-1:-0.2:3:log exact.b=1:2:3", 27, ["symlog"] * 3),
        ("--margins mismatch lost", 6, []),
    ],
)
def test_the_command_writes_a_page_and_a_table(words, count, scales, task, capsys, monkeypatch):
    """What is swept in equal ratios is drawn so, of either sign; the best cell is told."""
    found: list[str] = []
    monkeypatch.setattr("matplotlib.axes.Axes.set_xscale", lambda _, scale, **__: found.append(scale))
    assert main(["study", "line.py", *words.split(), "--no-compile", "--json", "--out", "out"]) == 0
    assert json.loads(capsys.readouterr().out)["versions"]["fpirhc"]
    assert "<html" in (page := Path("out/report.html").read_text())
    table = pd.read_csv("out/study.csv")
    assert len(table) == count
    if "--over" in words:
        own = table.loc[table.controller == "CTC+FPI"].set_index("variant").error
        assert f"at {own.idxmin()}." in re.sub("<[^>]*>", "", page)
    assert found == scales
