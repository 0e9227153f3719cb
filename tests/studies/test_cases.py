"""Named cases: a case is a problem, a comparison of cases is one of scenarios, and every wrong use says what to write.

The laws: the run of a case is the run of its problem, bit by bit; cases and random scenarios are served by one machine; a wrong
number is named by case and path, or by row and column.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from line import line_text

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.cli.verb import ExitCode
from fpirhc.errors import InvalidField, InvalidName, InvalidProblem, InvalidValue, ProblemFileError
from fpirhc.problem_files.problem_file import Task, in_case
from fpirhc.simulation import simulate
from fpirhc.studies.comparison.compare import check_gains
from fpirhc.studies.scenarios.bench import Bench, Conditions, scenarios
from fpirhc.studies.scenarios.draws import COMPARING
from fpirhc.symbolic.native import find_compiler

CASES = """
cases = fp.Cases({
    "usual": {},
    "weak": {"exact.b": 0.9, "group": "light"},
    "stiff": {"exact.k": 8.0, "exact.b": 1.2, "group": "heavy"},
    "known": {"known.b": 2.0, "group": "heavy"},
    "far": {"start.y": 1.0, "start.y'": -0.5, "seed": 7},
    "late": {"dead_time.measurement": 0.01},
    "narrow": {"limits.inputs.u.1": 4.0, "limits.inputs.u.0": -4.0},
    "other way": {"reference": fp.Trajectory(lambda t: {"y": 0.3 * ca.cos(t)}), "start.y": 0.3},
})
"""
TASK = (
    "period=5e-3, duration=1.0, measure_from=0.2, disturbances={'u': fp.Noise(0.1)}, "
    "dead_time=fp.DeadTime(measurement=0.0), limits=fp.Limits(inputs={'u': (-40.0, 40.0)})"
)
LINE = line_text(TASK, bounds="(0.5, 2.4)", more=CASES)


@pytest.fixture
def task(tmp_path, monkeypatch) -> Task:
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


def compared(task: Task, *patterns: str, folder: str = "out", **settings: Any) -> Any:
    return fp.compare_scenarios(task, cases=patterns, seed=3, folder=Path(folder), compiled=False, **settings)


# --- What a case is ---------------------------------------------------------------------------------------------------


def test_a_case_changes_what_it_states_and_nothing_else(task):
    """Parameters of either set, the start and inner numbers; the problem stays as it is."""
    plain, cases = task.problem, task.cases
    of = {name: cases.problem(name, plain) for name in cases.names}
    assert [of["stiff"].plant.exact.tolist(), of["stiff"].plant.approximate.tolist()] == [[1.2, 8.0], [1.0, 2.0]]
    assert [of["known"].plant.exact.tolist(), of["known"].plant.approximate.tolist()] == [[2.0, 5.0], [2.0, 2.0]]
    assert of["far"].start_state.tolist() == [1.0, -0.5]
    assert of["late"].dead_time.measurement == 0.01
    assert of["narrow"].limits.inputs["u"] == (-4.0, 4.0)
    assert of["other way"].reference is not plain.reference
    assert np.array_equal(of["usual"].plant.exact, plain.plant.exact)
    assert plain.start_state.tolist() == [0.5, 0.0]


def test_the_run_of_a_case_is_that_of_its_problem(task):
    """Bit by bit, in every case and with every controller, whichever loop it shares with other cases."""
    bench = Bench(task, Conditions(3, COMPARING, 0.0, compiled=False, named=True))
    for number, name in enumerate(task.cases.names):
        problem, seed = task.cases.problem(name, task.problem), bench._scenario(number).seed
        for controller in task.controllers:
            record = bench.record(number, controller)
            run = fp.simulate(problem, task.controllers[controller], seed=seed, compiled=False)
            assert record["metrics"]["rms_error"] == fp.measure(problem, run).values["rms_error"]
    loops = {id(one) for (owner, _), one in bench._simulators.items() if owner == "CTC"}
    # 'weak', 'stiff' and 'narrow' have the loop of 'usual': exact parameters and limits are data.
    assert len(loops) == len(task.cases.names) - 3


@pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
def test_a_loop_that_serves_one_case_is_compiled_where_its_run_is_long(task, monkeypatch):
    """A compiler takes longer than a short run; the numbers are the same."""
    bench = Bench(task, Conditions(3, COMPARING, 0.0, compiled=True, named=True))
    interpreted = Bench(task, Conditions(3, COMPARING, 0.0, compiled=False, named=True))
    for name, compiled in (("usual", True), ("known", False)):
        number = task.cases.names.index(name)
        assert bench._simulator("CTC", bench._scenario(number)).compiled == compiled
        assert bench.record(number, "CTC")["metrics"] == interpreted.record(number, "CTC")["metrics"]
    monkeypatch.setattr(simulate, "_SHORT_RUN", 0)
    long = Bench(task, Conditions(3, COMPARING, 0.0, compiled=True, named=True))
    assert long._simulator("CTC", long._scenario(task.cases.names.index("known"))).compiled


def test_dead_times_are_data_where_the_longest_is_stated(task):
    """'late' has the loop of 'usual' then, and the run of its problem."""
    roomy = fp.DeadTime(measurement=0.0, longest={"measurement": 0.02})
    task = replace(task, problem=replace(task.problem, dead_time=roomy))
    bench = Bench(task, Conditions(3, COMPARING, 0.0, compiled=False, named=True))
    records = {name: bench.record(task.cases.names.index(name), "CTC") for name in ("usual", "late")}
    assert len({id(one) for one in bench._simulators.values()}) == 1
    number = task.cases.names.index("late")
    alone = fp.simulate(
        task.cases.problem("late", task.problem),
        task.controllers["CTC"],
        seed=bench._scenario(number).seed,
        compiled=False,
    )
    assert records["late"]["metrics"]["rms_error"] == fp.measure(task.problem, alone).values["rms_error"]
    assert records["late"]["metrics"]["rms_error"] != records["usual"]["metrics"]["rms_error"]


def test_the_seed_of_a_case_is_its_own_or_the_studys(task):
    scenarios = Bench(task, Conditions(3, COMPARING, 0.0, compiled=False, named=True))._scenarios
    seeds = [scenarios[k].seed for k in range(8)]
    assert seeds[4] == 7
    assert len(set(seeds)) == len(seeds)
    other = Bench(task, Conditions(4, COMPARING, 0.0, compiled=False, named=True))._scenarios
    assert [other[k].seed == seeds[k] for k in range(8)] == [k == 4 for k in range(8)]


def test_exact_parameters_are_those_of_the_reality(task):
    """Where another plant moves, 'exact' means its parameters, also those that the model does not have."""
    plant = task.problem.plant
    real = replace(plant, parameters={**plant.parameters, "drag": fp.Parameter(0.0, 0.0, "1/s")})
    problem = replace(task.problem, reality=fp.Reality(real))
    cases = fp.Cases(
        {"drag": {"exact.drag": 0.4, "known.b": 1.1}, "none": {"reality": fp.Reality(plant), "exact.k": 6.0}}
    )
    moved = cases.problem("drag", problem)
    assert moved.real_plant.exact.tolist() == [1.1, 5.0, 0.4]
    assert moved.plant.approximate.tolist() == [1.1, 2.0]
    assert cases.problem("none", problem).real_plant.exact.tolist() == [1.6, 6.0]


# --- From a table -----------------------------------------------------------------------------------------------------

TABLE = """# a remark
case, group, exact.b, exact.k, start.y, seed
weak, light, 0.9, , ,
stiff, heavy, 1.2, 8, 0.4, 11
"""


def written(text: str) -> Path:
    path = Path("cases.csv")
    path.write_text(text)
    return path


def test_a_table_is_a_mapping(task):
    """An empty cell leaves the problem as it is."""
    cases = fp.Cases.from_csv(written(TABLE).resolve())
    assert cases.changes == {
        "weak": {"group": "light", "exact.b": 0.9},
        "stiff": {"group": "heavy", "exact.b": 1.2, "exact.k": 8.0, "start.y": 0.4, "seed": 11},
    }
    assert cases.problem("stiff", task.problem).plant.exact.tolist() == [1.2, 8.0]
    assert repr(cases) == "Cases(2 cases, groups light, heavy)"


def test_a_table_lies_beside_the_problem_file(task, tmp_path, monkeypatch):
    """A relative path begins at the file that names it, wherever the command is given."""
    written(TABLE)
    Path("line.py").write_text(line_text(TASK, bounds="(0.5, 2.4)", more='cases = fp.Cases.from_csv("cases.csv")\n'))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    cases = fp.load_problem("../line.py").cases
    assert cases is not None
    assert cases.names == ("weak", "stiff")


def test_a_table_may_have_words_and_columns_that_every_case_needs(task):
    """A word is its number; what is missing, empty or unknown is named by row and column, with what is expected."""
    cases: dict[str, Any] = {"needed": ("exact.b", "exact.k"), "words": {"exact.k": {"soft": 5.0, "stiff": 8.0}}}
    read = fp.Cases.from_csv(written("case,exact.b,exact.k\none,0.9,stiff\n").resolve(), **cases)
    assert read.changes == {"one": {"exact.b": 0.9, "exact.k": 8.0}}
    with pytest.raises(InvalidProblem) as wrong:
        fp.Cases.from_csv(written("case,exact.b,exact.k\none,0.9,hard\ntwo,,soft\n").resolve(), **cases)
    assert "row 2 (one), column 'exact.k': expected 'soft' or 'stiff', got 'hard'" in str(wrong.value)
    assert "row 3 (two), column 'exact.b': it is empty; expected a number, such as 3.5" in str(wrong.value)
    with pytest.raises(InvalidProblem, match=r"row 1: there is no column 'exact\.k', which every case needs\."):
        fp.Cases.from_csv(written("case,exact.b\none,0.9\n").resolve(), **cases)
    with pytest.raises(
        InvalidProblem, match=r"row 3 \(two\), column 'group': it is empty; expected the name of a group"
    ):
        fp.Cases.from_csv(written("case,group\none,old\ntwo,\n").resolve(), needed=["group"])
    with pytest.raises(InvalidProblem, match=r"row 2 \(one\), column 'exact\.b': expected 1 to 3, got 0\.9"):
        fp.Cases.from_csv(written("case,exact.b\none,0.9\n").resolve(), bounds={"exact.b": (1.0, 3.0)})
    with pytest.raises(InvalidField, match=r"from_csv\.needed: expected .*, got the text 'exact\.b'"):
        fp.Cases.from_csv(written("case,exact.b\none,0.9\n").resolve(), needed="exact.b")


# --- Comparisons ------------------------------------------------------------------------------------------------------


def test_patterns_name_cases_and_groups(task):
    matching = task.cases.matching
    assert matching(["all"]) == task.cases.names
    assert matching(["heavy"]) == ("stiff", "known")
    assert matching(["*r*", "late"]) == ("far", "late", "narrow", "other way")


def test_finished_cases_are_kept_whichever_are_asked_for_next(task):
    """A ledger of some cases goes on to all of them; what was run stays and is not run again."""
    compared(task, "heavy")
    before = Path("out/scenarios.jsonl").read_text().splitlines()
    everything = compared(task, "all")
    after = Path("out/scenarios.jsonl").read_text().splitlines()
    assert after[: len(before)] == before
    assert len(after) - len(before) == 6 * len(task.controllers)
    assert everything.count == 8
    assert [r["name"] for r in everything.records["CTC"]] == list(task.cases.names)


def test_processes_change_nothing(task):
    alone, two = compared(task, "all", folder="one"), compared(task, "all", folder="two", processes=2)
    assert alone.records == two.records


def test_the_worst_case_has_its_name_everywhere(task):
    """The case with the largest error is named in the verdict's table, in the facts and in the summary."""
    comparison = compared(task, "all")
    summary = comparison["CTC"]
    errors = {r["name"]: r["error"] for r in comparison.records["CTC"]}
    assert summary.worst_name == max(errors, key=lambda name: errors[name])
    assert summary.worst == max(errors.values())
    assert comparison.view.facts["controllers"]["CTC"]["worst_name"] == summary.worst_name
    assert "of 8 cases" in comparison.verdict[0]
    assert comparison.view.tables[0].title == "line: 8 cases"


def test_the_command(task, capsys):
    """`compare --cases` writes a report; `run --case` is one of its runs, to look into."""
    assert main(["compare", "line.py", "--cases", "heavy", "far", "--no-compile", "--json"]) == ExitCode.FINISHED
    printed = json.loads(capsys.readouterr().out)
    assert printed["scenarios"] == 3
    assert Path("results/line/cases_seed0/report.html").is_file()
    assert main(["run", "line.py", "CTC", "--case", "far", "--no-compile", "--seed", "7"]) == ExitCode.FINISHED
    run = fp.load_run("results/line/CTC_far.npz")
    error = fp.measure(task.cases.problem("far", task.problem), run).rms_error["y"]
    record = next(r for r in compared(task, "far").records["CTC"])
    assert record["metrics"]["rms_error"]["y"] == error


def test_the_options_of_a_case_that_begins_as_an_option_does_run_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE.replace('"far": {', '"-far": {'))
    task = fp.load_problem("line.py")
    assert task.cases
    options = scenarios(task, Conditions(0, COMPARING, 0.0, compiled=False, named=True)).options(
        task.cases.names.index("-far")
    )
    assert main(["run", "line.py", "CTC", "--no-compile", *options]) == ExitCode.FINISHED


@pytest.mark.slow
def test_patients_for_whom_the_gain_is_too_large():
    """In 14 of the gallery's 44 the gain is beyond its limit, and there adaptation is worse; in 24 of the others it is better."""
    task = fp.load_problem("anaesthesia")
    assert task.cases is not None
    bench = Bench(task, Conditions(0, COMPARING, 0.0, compiled=True, named=True))
    beyond, better = [], []
    for number, name in enumerate(task.cases.names):
        one = in_case(task, name)
        try:
            check_gains(one, {"CTC+FPI": one.controllers["CTC+FPI"]})
        except InvalidProblem:
            beyond.append(name)
        plain, adaptive = (bench.record(number, controller)["error"] for controller in ("CTC", "CTC+FPI"))
        better += [name] if adaptive < plain else []
    assert len(beyond) == 14
    assert len(better) == 24
    assert not set(beyond) & set(better)


# --- The figure -------------------------------------------------------------------------------------------------------


def judged_by(task: Task, name: str) -> Task:
    """The task with a figure that is better when larger, and one that is better when smaller."""
    figures = (
        fp.figures.Nadir("output.y" if task.problem.plant.outputs else "state.y"),
        fp.figures.Total("true_error.y"),
    )
    return replace(task, metrics=[*task.metrics, *figures], headline_metric=name)


def test_a_comparison_speaks_of_the_headline_metric(task):
    """By hand from the records: medians, the worst, and who is better; larger is better by the metric, not by the reader."""
    task = judged_by(task, "nadir")
    comparison = compared(task, "all")
    nadirs = {c: np.array([r["metrics"]["nadir"][""] for r in rs]) for c, rs in comparison.records.items()}
    plain, adaptive = comparison["CTC"], comparison["CTC+FPI"]
    assert plain.median == -np.median(nadirs["CTC"])
    assert plain.worst == -nadirs["CTC"].min()
    assert plain.worst_name == comparison.records["CTC"][int(nadirs["CTC"].argmin())]["name"]
    assert adaptive.better == np.sum(nadirs["CTC+FPI"] > nadirs["CTC"])
    assert adaptive.difference is not None
    assert adaptive.difference.median == pytest.approx(-np.median(nadirs["CTC+FPI"] - nadirs["CTC"]))
    assert plain.worst_metrics["nadir"][""] == nadirs["CTC"].min()
    table = comparison.view.tables[0]
    shown = dict(zip((column.head for column in table.columns), table.rows[0].cells, strict=True))
    assert shown["worst nadir"] == f"{nadirs['CTC'].min():.3g} m"
    assert shown["median nadir"] == f"{np.median(nadirs['CTC']):.3g} m"
    assert comparison.view.facts["headline"] == "nadir"


def test_the_headline_needs_no_new_runs(task):
    """Records hold every metric, so that another figure is another reading of them."""
    task = judged_by(task, "nadir")
    compared(task, "all")
    before = Path("out/scenarios.jsonl").read_bytes()
    again = compared(task, "all", headline="rms_error.y")
    assert Path("out/scenarios.jsonl").read_bytes() == before
    assert again["CTC"].median == np.median([r["metrics"]["rms_error"]["y"] for r in again.records["CTC"]])


def test_the_verdict_of_one_run_speaks_of_it_first(task):
    """The sentence has both numbers, and its outcome is that of the metric's direction."""
    task = judged_by(task, "nadir")
    comparison = fp.compare(task, seed=0, compiled=False)
    first = comparison.findings[0]
    before, after = (e.metrics["nadir"][""] for e in comparison.entries)
    assert first.pair == ("CTC", "CTC+FPI")
    assert first.text.startswith("CTC+FPI ")
    assert "nadir" in first.text
    assert "larger is better" in first.text
    better = (
        {True: "better", False: "worse"}[after > before] if not 0.9 <= abs(after / before) <= 1.1 else "no difference"
    )
    assert first.outcome is not None
    assert first.outcome.value == better
    assert comparison.findings[1].text.startswith("CTC+FPI")


def test_groups_are_comparisons_of_their_own(task):
    everything, heavy = compared(task, "all"), compared(task, "heavy", folder="heavy")
    assert list(everything.groups) == ["heavy", "light"]
    for alone, one in zip(heavy.summaries, everything.groups["heavy"], strict=True):
        assert (alone.median, alone.worst, alone.worst_name, alone.ratio) == (
            one.median,
            one.worst,
            one.worst_name,
            one.ratio,
        )
    assert len(everything.view.tables[1].rows) == 4


def test_what_is_worst_stands_first(task):
    """Whoever reads one column after the name reads the worst case, its name, and failures."""
    heads = [column.head for column in compared(task, "all").view.tables[0].columns]
    assert heads[:4] == ["controller", "worst error", "in case", "failures"]


def test_tuning_on_some_cases_leaves_the_others(task):
    """The cost is the mean over the cases that are named, and the result says which they are and how many there are."""
    pytest.importorskip("optuna")
    task = replace(task, tuning={"CTC+FPI": {"deformation.gain": fp.LogSpan(-1.0, -0.1)}})
    tuning = fp.tune(task, trials=2, seed=0, folder=Path("tuning"), cases=["heavy"], compiled=False)
    assert tuning.conditions == "cases stiff, known: 2 of 8"
    bench = Bench(task, Conditions(0, COMPARING, 0.0, compiled=False, named=True))
    errors = [bench.record(k, "CTC+FPI")["error"] for k in (2, 3)]
    assert tuning.entries[0].cost_before == pytest.approx(np.mean(errors), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "message"), [("nadr", "Did you mean 'nadir'"), ("rms_error", r"give one: 'rms_error\.NAME'")]
)
def test_wrong_headlines(name, message, task):
    with pytest.raises((InvalidName, InvalidValue), match=message):
        compared(judged_by(task, name), "all")


# --- Wrong uses -------------------------------------------------------------------------------------------------------

WRONG_CASES: dict[str, tuple[Any, str]] = {
    "no case": ({}, r"there is none; expected \{.heavy.: "),
    "a name that is empty": ({" ": {}}, "the name of a case is a text that is not empty"),
    "the name of all": ({"all": {}}, "'all' means every case; choose another name"),
    "no mapping": ({"weak": 0.9}, r"Cases\.changes\['weak'\]: expected .*got 0\.9"),
    "a path that is no text": ({"weak": {1: 0.9}}, r"Cases\.changes\['weak'\]: name 1: expected a text, got 1"),
    "a group that is no text": ({"weak": {"group": 1}}, "case 'weak': 'group' is a text, got 1"),
    "a seed below zero": ({"weak": {"seed": -1}}, "case 'weak': 'seed' is a whole number of at least 0, got -1"),
}
WRONG_PATHS: dict[str, tuple[Any, str]] = {
    "a parameter that is not there": ({"exact.c": 1.0}, r"'exact\.c': .* there is no 'c'\. .*Valid: b, k"),
    "a parameter alone": (
        {"b": 1.0},
        r"the problem has no 'b'\. It is a parameter: 'exact\.b' is what moves, 'approximate\.b'",
    ),
    "a state alone": ({"y'": 1.0}, r"It is a state: 'start\.y'' is its first value"),
    "an input alone": ({"u": 1.0}, r"It is an input: 'limits\.inputs\.u' are its limits"),
    "a field that is misspelt": (
        {"dead_tme.measurement": 0.1},
        r"the problem has no 'dead_tme.*Did you mean 'dead_time'\?",
    ),
    "a field inside": ({"dead_time.measurment": 0.1}, r"Did you mean 'measurement'\?"),
    "a parameter outside its bounds": ({"exact.b": -70.0}, r"'exact\.b': expected 0\.5 to 2\.4 1/kg, got -70"),
    "no number": ({"exact.b": "1.2"}, r"'exact\.b': expected a finite number, got the text '1\.2'"),
    "an infinite start": ({"start.y": float("inf")}, r"'start\.y': expected a finite number, got inf"),
    "a state without its name": ({"start": {"y": 1.0}}, r"'start' alone names no state; .*, 'start\.NAME'"),
    "a dead time that is not stated": (
        {"dead_time.inputs.u": 0.1},
        r"write dead_time=fp.DeadTime\(inputs={'u': 0.0}\)",
    ),
    "a dead time of no input": ({"dead_time.inputs.x": 0.1}, r"has an input, and there is no 'x'\. Valid: u"),
    "a parameter twice": ({"exact.b": 1.0, "known.b": 2.0}, r"'known.b' and 'exact.b' set the same number"),
    "an interval and its end": (
        {"limits.inputs.u.1": 9.0, "limits.inputs.u": (-3.0, 3.0)},
        r"'limits.inputs.u' and 'limits.inputs.u.1' set the same number",
    ),
    "a limit that is none": ({"limits.inputs.u.1": -50.0}, r"case 'weak': .*u"),
}
WRONG_TABLES = {
    "no column of names": ("name,exact.b\nweak,1\n", r"cases\.csv: row 1: there is no column 'case'"),
    "semicolons": ("case;exact.b\nweak;1,5\n", "^cases.csv: row 1: expected columns .* separated by commas, got ';'$"),
    "tabs": ("exact.b\tcase\n1\tweak\n", r"separated by commas, got '\\t'$"),
    "nothing": ("", "^cases.csv: row 1: it is empty; expected 'case' and the heads of the other columns$"),
    "remarks alone": ("# a remark\n", "^cases.csv: row 1: it is empty"),
    "a head alone": ("# a remark\ncase,exact.b\n", "^cases.csv: row 2: no row follows; expected one for every case$"),
    "a head in capitals": ("case,exact.B\nweak,1\n", r"there is no 'B'\. Did you mean 'b'\?"),
    "a name twice": ("case,exact.b\nweak,1\nweak,2\n", "row 3, column 'case': 'weak' stands in row 2 too"),
    "a column twice": ("case,exact.b,exact.b\nweak,1,2\n", "row 1: column 'exact.b' stands 2 times"),
    "too few cells": ("case,exact.b\nweak\n", "row 2: it has 1 cells, expected 2"),
    "no number": (
        "case,exact.b\nweak,1\nstiff,heavy\n",
        r"row 3 \(stiff\), column 'exact\.b': expected a number, .* got 'heavy'",
    ),
    "no name": ("case,exact.b\n,1\n", "row 2, column 'case': it is empty"),
    "a wrong column": ("case,exact.c\nweak,1\nstiff,1\n", r"cases\.csv, column 'exact\.c': .* there is no 'c'"),
    "a negative weight": (
        "case,exact.b\nweak,1\nodd,-70\n",
        r"cases\.csv, row 3 \(odd\), column 'exact\.b': expected 0\.5 to 2\.4 1/kg, got -70",
    ),
}


@pytest.mark.parametrize("wrong", WRONG_CASES)
def test_wrong_cases(wrong):
    changes, message = WRONG_CASES[wrong]
    with pytest.raises(InvalidProblem, match=message):
        fp.Cases(changes)


@pytest.mark.parametrize("wrong", WRONG_PATHS)
def test_wrong_paths(wrong, task):
    """The case and the path are named, and what could stand there."""
    changes, message = WRONG_PATHS[wrong]
    with pytest.raises(InvalidProblem, match=message):
        fp.Cases({"weak": changes}).problem("weak", task.problem)


@pytest.mark.parametrize("wrong", WRONG_TABLES)
def test_wrong_tables(wrong, task):
    text, message = WRONG_TABLES[wrong]
    with pytest.raises(InvalidProblem, match=message):
        fp.Cases.from_csv(written(text).resolve()).check(task.problem)


@pytest.mark.parametrize(
    ("encoding", "found"), [("latin-1", "row 2: .* got the byte 0xe4"), ("utf-16", "row 1: .* 0xf[ef]")]
)
def test_a_table_is_text_in_utf_8(encoding, found, task):
    """Any other encoding is told with the row of its first byte; a mark of byte order in front is passed over."""
    text = "case,exact.b\nträge,1\n"
    Path("cases.csv").write_bytes(text.encode(encoding))
    with pytest.raises(InvalidProblem, match=f"cases.csv: {found}"):
        fp.Cases.from_csv(Path("cases.csv").resolve())
    Path("cases.csv").write_bytes(text.encode("utf-8-sig"))
    assert fp.Cases.from_csv(Path("cases.csv").resolve()).names == ("träge",)


def test_a_right_case_is_refused_beside_wrong_ones(task):
    """Names are checked at the first use, whichever case it is of, and all mistakes are told together."""
    cases = fp.Cases({"right": {}, "weak": {"exact.bb": 1.0}, "far": {"start.z": 0.1}})
    with pytest.raises(InvalidProblem, match="2 mistakes") as error:
        cases.problem("right", task.problem)
    assert all(name in str(error.value) for name in ("'exact.bb'", "'start.z'"))
    name: Any = "right"
    with pytest.raises(InvalidField, match="the values of 'name' and 'problem' are swapped"):
        cases.problem(task.problem, name)


def test_all_mistakes_of_a_table_are_told_together(task):
    """A wrong column once, however many rows it has, and every wrong number."""
    text = "case,exact.c,exact.b\nweak,1,9\nstiff,1,-1\nfar,2,1\n"
    with pytest.raises(InvalidProblem) as error:
        fp.Cases.from_csv(written(text).resolve()).check(task.problem)
    assert str(error.value).count("exact.c") == 1
    assert [f"row {k}" in str(error.value) for k in (2, 3, 4)] == [True, True, False]


def test_wrong_requests(task):
    with pytest.raises(InvalidName, match=r"no case matches 'hevy'\. Did you mean 'heavy'\?"):
        compared(task, "hevy")
    with pytest.raises(InvalidValue, match="give either cases, or a number of scenarios"):
        compared(task, "all", count=3)
    with pytest.raises(InvalidValue, match=r"problem 'line' has no cases; add to its file cases = fpirhc\.Cases"):
        compared(replace(task, cases=None), "all")
    Path("line.py").write_text(line_text(TASK, more='cases = {"weak": {}}\n'))
    with pytest.raises(ProblemFileError, match=r"line \d+: expected cases = fpirhc\.Cases\("):
        fp.load_problem("line.py")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cases", "all", "--scenarios", "3"], "--cases and --scenarios are two comparisons"),
        (["--cases", "all", "--mismatch", "3"], "--cases have the parameters that they state"),
        (["--cases", "all", "--optimisers", "all"], "--optimisers cannot be combined with --cases"),
        (["--cases", "nobody"], "no case matches 'nobody'"),
    ],
)
def test_wrong_commands(options, message, task, capsys):
    assert main(["compare", "line.py", *options]) == ExitCode.BAD_INPUT
    assert message in capsys.readouterr().err


# --- The shipped tables of people -------------------------------------------------------------------------------------

CURVE, TEENAGER = "patient 01,elderly,2.367,91.1,6.722,1.793", "adolescent#003,44.791,0.046752"
WRONG_PEOPLE = {
    "anaesthesia_patients": {
        "exact.C50 -> exact.EC50": r"row 3: there is no column 'exact\.C50', .* Did you mean 'exact\.EC50'\?",
        "case,group -> group": r"row 3: there is no column 'case'",
        f"{CURVE} -> {CURVE.replace('91.1,', '')}": "row 4: it has 5 cells, expected 6",
        "6.722 -> -6.722": r"row 4 \(patient 01\), column 'exact\.C50': expected 0\.5 to 20 mg/l, got -6\.722",
        "6.722 -> unknown": r"row 4 \(patient 01\), column 'exact\.C50': expected a number, .* got 'unknown'",
    },
    "diabetes_people": {
        "case,BW -> case,mass": r"row 3: there is no column 'BW', which every case needs",
        f"{TEENAGER} -> adolescent#003,-65,0.046752": r"row 6 \(adolescent#003\), column 'BW': expected 2 to 300, got -65",
        f"{TEENAGER} -> adolescent#003,44.791,": r"row 6 \(adolescent#003\), column 'kabs': it is empty",
        "145.9,0.6477 -> -9,0.6477": r"row 6 \(adolescent#003\), column 'Gb': expected 40 to 400, got -9",
    },
}


@pytest.mark.parametrize(
    ("table", "change", "message"), [(table, *one) for table, all_ in WRONG_PEOPLE.items() for one in all_.items()]
)
def test_wrong_people(table, change, message, tmp_path):
    """A person who cannot be is refused before a run: row, column, and what was expected."""
    gallery, problem = Path(fp.__file__).parents[1] / "problems" / "gallery", f"{table.partition('_')[0]}.py"
    (tmp_path / problem).write_text((gallery / problem).read_text())
    text, (right, other) = (gallery / f"{table}.csv").read_text(), change.split(" -> ")
    assert right in text
    (tmp_path / f"{table}.csv").write_text(text.replace(right, other, 1))
    with pytest.raises((InvalidProblem, ProblemFileError), match=message):
        in_case(fp.load_problem(str(tmp_path / problem)), "patient 01")
