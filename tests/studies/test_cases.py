"""Named cases: a case is a problem, a comparison of cases is one of scenarios, and every wrong use says what to write.

The law: the run of a case is the run of its problem, bit by bit; a wrong number is named by case and path.
"""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from helpers.line import line_text

import fpirhc as fp
from fpirhc.errors import InvalidField, InvalidName, InvalidProblem
from fpirhc.problem_files.problem_file import Task

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


def test_a_table_of_pandas_is_a_mapping(task):
    """A row is a case; an empty cell is a wrong number, and no number of the problem."""
    table = "case,group,exact.b,exact.k,seed\nweak,light,0.9,5,3\nstiff,heavy,1.2,8,11\n"
    cases = fp.Cases(pd.read_csv(io.StringIO(table), index_col="case").to_dict("index"))
    assert cases.problem("stiff", task.problem).plant.exact.tolist() == [1.2, 8.0]
    assert (cases.seed("stiff"), cases.group("weak")) == (11, "light")
    assert repr(cases) == "Cases(2 cases, groups light, heavy)"
    holed = fp.Cases(pd.read_csv(io.StringIO(table.replace("0.9", "")), index_col="case").to_dict("index"))
    with pytest.raises(InvalidProblem, match=r"case 'weak', 'exact\.b': expected a finite number, got nan"):
        holed.problem("stiff", task.problem)


# --- Comparisons ------------------------------------------------------------------------------------------------------


def test_cases_are_asked_for_by_name_and_group(task):
    matching = task.cases.matching
    assert matching(["all"]) == task.cases.names
    assert matching(["heavy", "usual"]) == ("usual", "stiff", "known")
    with pytest.raises(InvalidName, match=r"case 'havy' is unknown\. Did you mean 'heavy'"):
        matching(["havy"])


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
    "a dead time that is not stated": ({"dead_time.inputs.u": 0.1}, r"'dead_time.inputs' of the problem has no 'u'"),
    "a parameter twice": ({"exact.b": 1.0, "known.b": 2.0}, r"'known.b' and 'exact.b' set the same number"),
    "an interval and its end": (
        {"limits.inputs.u.1": 9.0, "limits.inputs.u": (-3.0, 3.0)},
        r"'limits.inputs.u' and 'limits.inputs.u.1' set the same number",
    ),
    "a limit that is none": ({"limits.inputs.u.1": -50.0}, r"case 'weak': .*u"),
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


def test_a_right_case_is_refused_beside_wrong_ones(task):
    """Names are checked at the first use, whichever case it is of, and all mistakes are told together."""
    cases = fp.Cases({"right": {}, "weak": {"exact.bb": 1.0}, "far": {"start.z": 0.1}})
    with pytest.raises(InvalidProblem, match="2 mistakes") as error:
        cases.problem("right", task.problem)
    assert all(name in str(error.value) for name in ("'exact.bb'", "'start.z'"))
    name: Any = "right"
    with pytest.raises(InvalidField, match="the values of 'name' and 'problem' are swapped"):
        cases.problem(task.problem, name)


def test_a_wrong_path_is_told_once_and_every_wrong_number(task):
    cases = {name: {"exact.c": 1.0, "exact.b": b} for name, b in {"weak": 9.0, "stiff": -1.0, "far": 1.0}.items()}
    with pytest.raises(InvalidProblem) as error:
        fp.Cases(cases).check(task.problem)
    assert str(error.value).count("exact.c") == 1
    assert [f"case '{name}'" in str(error.value) for name in cases] == [True, True, False]
