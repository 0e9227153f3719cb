"""Paired scenarios: the same for everyone, told as they are, and never lost, repeated or mixed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from line import EXACT, line_text

import fpirhc as fp
from fpirhc.errors import InvalidProblem, InvalidValue
from fpirhc.plant.plant import exact_ranges
from fpirhc.problem_files.problem_file import Task

LINE = line_text(
    "period=5e-3, duration=1.5, measure_from=0.5, disturbances={'u': fp.Noise(0.1)}", bounds="(0.5, 2.4)", more=EXACT
)


@pytest.fixture
def task(tmp_path, monkeypatch) -> Task:
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


# --- Draws ------------------------------------------------------------------------------------------------------------


def test_draws_that_could_leave_physical_bounds_are_refused(task):
    """The parameter is named, with how far it may be drawn: b = 1.6 may grow by one half to its bound of 2.4."""
    exact_ranges(task.problem.plant, 49.9)
    with pytest.raises(InvalidProblem, match=r"parameter 'b'.*at most 50 %"):
        exact_ranges(task.problem.plant, 51.0)
    for percent in (100.0, -1.0, math.nan):
        with pytest.raises(InvalidValue, match="at least 0 and below 100"):
            exact_ranges(task.problem.plant, percent)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ((2.0, 3.0), "parameter 'b': approximate is outside"),
        ((3.0, 0.0), r"parameter 'b': .*\(lowest, highest\)"),
        (0.0, r"Parameter.bounds: expected \(a number, a number\)"),
    ],
)
def test_bounds_of_parameters_are_checked(bounds, message, task):
    plant = task.problem.plant
    with pytest.raises(InvalidProblem, match=message):
        replace(plant, parameters={**plant.parameters, "b": fp.Parameter(1.0, 2.5, "1/kg", bounds)})


# --- Statistics -------------------------------------------------------------------------------------------------------


# --- Ledger -----------------------------------------------------------------------------------------------------------


# --- Processes --------------------------------------------------------------------------------------------------------


# --- The whole study --------------------------------------------------------------------------------------------------
