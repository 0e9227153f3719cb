"""Named cases: a case is a problem, a comparison of cases is one of scenarios, and every wrong use says what to write.

The laws: the run of a case is the run of its problem, bit by bit; cases and random scenarios are served by one machine; a wrong
number is named by case and path, or by row and column.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from line import line_text

import fpirhc as fp
from fpirhc.errors import InvalidField, InvalidProblem, ProblemFileError
from fpirhc.problem_files.problem_file import Task, in_case

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


# --- The figure -------------------------------------------------------------------------------------------------------


def judged_by(task: Task, name: str) -> Task:
    """The task with a figure that is better when larger, and one that is better when smaller."""
    figures = (
        fp.figures.Nadir("output.y" if task.problem.plant.outputs else "state.y"),
        fp.figures.Total("true_error.y"),
    )
    return replace(task, metrics=[*task.metrics, *figures], headline_metric=name)


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
