"""Figures of merit by value, on runs that were made by hand; 50 cycles of 0.1 s are measured, from t = 5 s on."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hand_made_runs import CYCLES, problem, run, step

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.errors import InvalidValue

figures = fp.figures
# Ten before the measured part, which does not count; then 3 and -4 in turn.
COMMAND = np.where(np.arange(CYCLES) < 50, 10.0, np.where(np.arange(CYCLES) % 2, 3.0, -4.0))


@pytest.mark.parametrize(
    ("figure", "value", "unit", "better"),
    [
        (figures.InBand("command.u", 2.0, 3.0), 0.5, "1", "larger"),
        (figures.TimeOver("command.u", 2.9), 2.5, "s", "smaller"),
        (figures.TimeOver("command.u", 3.0), 0.0, "s", "smaller"),
        (figures.Total("command.u"), -2.5, "N s", "smaller"),
        (figures.Largest("command.u"), 4.0, "N", "smaller"),
        (figures.Nadir("command.u"), -4.0, "N", "larger"),
        (figures.Energy("command.u"), 62.5, "(N)^2 s", "smaller"),
        (figures.Norm(["command.u"]), math.sqrt(62.5), "", "smaller"),
        (figures.Norm(["command.u", "command.u"], power=1.0), 35.0, "", "smaller"),
        (figures.Norm(["command.u"], power=math.inf), 4.0, "N", "smaller"),
        (figures.Largest(fp.Quantity("half", "kN", lambda r: r["command.u"] / 2)), 2.0, "kN", "smaller"),
    ],
)
def test_figures_have_the_value_of_their_definition(figure, value, unit, better):
    metrics = fp.measure(problem(), run(0.0, command=COMMAND), [figure])
    assert metrics[figure.name][""] == pytest.approx(value)
    assert metrics.units[figure.name][""] == unit
    assert figure.better == better
    ended = fp.measure(problem(), run(0.0, command=COMMAND, stop="limits"), [figure])
    assert math.isnan(ended[figure.name][""])


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_an_overshoot_is_beyond_the_last_change_of_the_reference(direction):
    """The reference steps at 6 s; 0.2 m beyond it counts and 0.5 m short of it does not, whatever the step's direction."""
    reference = direction * step(0.0, 1.0, 60)
    error = direction * np.where(np.arange(CYCLES) == 61, 0.5, np.where(np.arange(CYCLES) == 70, -0.2, 0.0))
    metrics = fp.measure(problem(), run(error, reference=reference), [figures.Overshoot("y")])
    assert metrics["overshoot"][""] == pytest.approx(0.2)
    assert metrics.units["overshoot"][""] == "m"
    short = fp.measure(problem(), run(np.abs(error) * direction, reference=reference), [figures.Overshoot("y")])
    assert short["overshoot"][""] == 0.0


def test_the_first_direction_is_that_from_the_start_to_the_reference():
    """A set point that never moves: the plant begins 1 m below it and goes 0.3 m beyond."""
    metrics = fp.measure(problem(), run(step(1.0, -0.3, 60), reference=np.zeros(CYCLES)), [figures.Overshoot("y")])
    assert metrics["overshoot"][""] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: figures.InBand("command.u", 3.0, 2.0), "low is 3 and high is 2; expected low < high"),
        (lambda: figures.Norm([]), "power is 2 of 0 signals; expected at least 1 of at least one signal"),
        (lambda: figures.Norm(["command.u"], power=0.5), "power is 0.5 of 1 signals"),
    ],
)
def test_figures_that_mean_nothing_are_refused(wrong, message):
    with pytest.raises(InvalidValue, match=message):
        wrong()


def test_a_signal_that_is_not_there_breaks_its_figure_alone():
    metrics = fp.measure(problem(), run(0.0), [figures.Largest("comand.u"), figures.Nadir("command.u")])
    assert metrics["nadir"][""] == 0.0
    assert "metric 'largest'" in metrics.broken[0]
    assert "Did you mean 'command.u'?" in metrics.broken[0]


FILE = """
import fpirhc as fp
_task = fp.load_problem("two_mass")
problem = _task.problem
controllers = {name: _task.controllers[name] for name in ("CTC", "CTC+FPI (eq 3)")}
metrics = (fp.figures.TimeOver("true_error.q1", 0.01), fp.figures.Largest("command.Q1", name="largest_force"))
"""


def test_figures_of_a_problem_file_stand_in_its_table(tmp_path, monkeypatch, capsys):
    """A user's journey: two lines in the file, two columns in the table and two numbers in the results."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(FILE)
    main(["compare", "mine.py", "--no-compile", "--out", "out"])
    rows = capsys.readouterr().out
    assert "over    force" in rows
    assert rows.split("CTC+FPI (eq 3)  0.00346")[1].split("\n")[0].split()[-2:] == ["0", "86.6"]
    results = json.loads((tmp_path / "out" / "results.json").read_text())["controllers"]
    assert results["CTC"]["time_over"] == pytest.approx(3.93, abs=0.01)
    assert results["CTC+FPI (eq 3)"]["largest_force"] == pytest.approx(86.63, abs=0.01)
