"""Typical mistakes in problem files: each is refused with its file and line, its cause and how to mend it, and without a traceback.

Each case changes one place of a correct file. What stands in a message is what a user needs: the line of the change, what is wrong
there, and what to write instead. `test_wrong_files` has the mistakes of people who come from other tools.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from first_files import changes_of
from mutated_problems import SOURCE
from raw_errors import raw_error

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.cli.verb import ExitCode
from fpirhc.controllers.check import checked
from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidField
from fpirhc.fields.checked import Checked, expects_whole_number
from fpirhc.symbolic.live import SymbolicNumber

# The name of a mistake, the old piece of the correct file and the new one, and what must be said: the cause and the mend.
MISTAKES = changes_of("""
class without parentheses
  fp.Paired(fp.Sigmoid(gain=-0.2, scale=10.0), cycles=1) -> fp.Sigmoid
    ComputedTorque.deformation: expected a Deformation, got the class Sigmoid ... write Sigmoid(gain=...)
optimiser by name
  fp.RecedingHorizon(optimiser), -> fp.RecedingHorizon(optimiser="ipopt"),
    expected an Optimiser, got the text 'ipopt' ... write fp.Ipopt()
optimiser by a name of the command line
  fp.RecedingHorizon(optimiser), -> fp.RecedingHorizon(optimiser="fixed-point"),
    expected an Optimiser ... write fp.FixedPoint(iterations=..., tolerance=...)
text for True or False
  fp.RecedingHorizon(optimiser), -> fp.RecedingHorizon(fp.FixedPoint(3, second_start="no")),
    FixedPoint.second_start: expected True or False, got the text 'no'
path of two arguments
  lambda view: view.state.y + view.state.z -> lambda x, u: x.y
    expected a function of 1 argument
path with its text and function swapped
  fp.PathConstraint(lambda view: view.state.y + view.state.z, upper=3.0, unit="m") ->
      fp.PathConstraint("m", lambda view: view.state.y)
    PathConstraint.expression: expected a function of 1 argument, got the text 'm'
reference that returns a number
  lambda t: {"y": ca.sin(t), "z": 0.1 * ca.cos(t)} -> lambda t: 0.5
    reference must return {name: expression}, got 0.5
reference without a coordinate
  "z": 0.1 * ca.cos(t) ->
    coordinate 'z' has no nominal motion ... add 'z' to the reference
negative weight
  "z": 10.0, "y'": 0.1} -> "z": -10.0}
    Quadratic.states['z']: expected a finite number of at least 0, got -10.0
limits that no number meets
  "force": (-20.0, 20.0) -> "force": (float("inf"), float("inf"))
    'force' has limits (inf, inf) that no number meets ... a free side is -inf below, inf above
limits by one number
  "force": (-20.0, 20.0) -> "force": 20.0
    Limits.inputs['force']: expected (a number, a number)
too many cycles
  duration=0.1 -> duration=1e9
    more than 1e+09 cycles ... shorten it
comma behind a number
  gain=-0.2, scale -> gain=(-0.2,), scale
    Sigmoid.gain: expected a finite number ... remove the comma
stages with a point
  stages=4 -> stages=4.0
    Horizon.stages: expected a whole number ... write 4
zero accuracy
  fp.FixedPoint(iterations=1, tolerance=1e-2) -> fp.Ipopt(accuracy=0)
    Ipopt.accuracy: expected a number above 0
if on a symbol
  u.lift / p.mass - 9.81 -> u.lift / p.mass if q.z > 0 else 0
    a symbol is neither true nor false ... use ca.if_else
max of a symbol
  u.lift / p.mass - 9.81 -> u.lift / p.mass - max(q.z, 0)
    max() and min() cannot act on it ... ca.fmax
math on a symbol
  ca.sin(t),  -> math.sin(t),
    math.sin(...) of a symbol is NaN ... use ca.sin
numpy array of symbols
  u.lift / p.mass - 9.81 -> np.array([u.lift, q.z])
    must be one scalar expression, got an array of the shape (2,)
symbol as a setting
  gain=-0.3 -> gain=ca.SX.sym("g")
    Affine.gain: expected a finite number other than zero (no adaptation is Identity()), got a CasADi ... a setting is a number
response that returns nothing
  return {"y" -> _ = {"y"
    response must return {name: expression}, got None ... return
misspelt parameter
  p.friction -> p.fricton
    parameter 'fricton' is unknown ... Did you mean 'friction'?
headline of one name
  ("CTC", "CTC+FPI") -> "CTC"
    headline must be a pair of names
program ended by the file
  headline = ("CTC", "CTC+FPI") -> raise SystemExit(0)
    the file ends the program ... leave the exit out
forgotten import
  import casadi as ca -> import casadi
    name 'ca' is not defined
""")
SOURCES = SOURCE.replace("import casadi as ca\n", "import math\nimport numpy as np\nimport casadi as ca\n")


@pytest.mark.parametrize("name", MISTAKES)
def test_a_typical_mistake_is_explained_in_place(name, tmp_path, monkeypatch, capsys):
    [(old, new)], expected = MISTAKES[name]
    assert SOURCES.count(old) >= 1
    text = SOURCES.replace(old, new, 1)
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(text, encoding="utf-8")
    assert main(["compare", "mine.py"]) == ExitCode.BAD_INPUT
    printed = capsys.readouterr()
    assert printed.out == ""
    said = " ".join(printed.err.split())
    assert said.startswith("fpirhc: ")
    assert "mine.py" in said
    assert all(words in said for words in expected)
    assert "Traceback" not in said
    # The line is that of the statement or of the change itself.
    lines = {int(number) for number in re.findall(r"line (\d+)", said)}
    assert lines & _possible_lines(text, SOURCES.index(old))


def _possible_lines(text: str, place: int) -> set[int]:
    """Lines from the beginning of the changed statement to the change; for a definition, also the statements that use it."""
    at = text[:place].count("\n") + 1
    lines = text.splitlines()
    starts = [k for k, line in enumerate(lines, 1) if line and not line[0].isspace() and line[0] not in ")}"]
    first = max(k for k in starts if k <= at)
    users = [k for k in starts if k > at] if lines[first - 1].startswith(("def", "import")) else []
    return {*range(first, at + 1), *users}


def test_all_mistakes_of_a_value_are_said_together():
    wrong: dict[str, Any] = {"gain": "a", "shift": None, "scal": 1.0}
    with pytest.raises(InvalidField, match=r"(?s)3 mistakes.*no field 'scal'.*Sigmoid.gain.*Sigmoid.shift") as caught:
        fp.Sigmoid(**wrong)
    assert "test_mistakes.py, line" in str(caught.value)


# --- The mechanism ----------------------------------------------------------------------------------------------------


class Live(SymbolicNumber):
    """A number that stands for a symbol."""


def test_a_number_that_stands_for_a_symbol_is_a_number_and_a_bare_symbol_is_none():
    live: Any = Live()
    assert fp.Parameter(approximate=live, exact=1.0, unit="kg").approximate is live
    for symbol in (ca.SX.sym("a"), ca.MX.sym("a")):
        bare: Any = symbol
        with pytest.raises(InvalidField, match="a CasADi symbol"):
            fp.Parameter(approximate=bare, exact=1.0, unit="kg")


@dataclass(frozen=True)
class ExternalPlant(Deformation):
    """A map of another distribution, which has no line for checks."""

    gain: float
    inner: Deformation | None = None
    spans: dict[str, tuple[float, float]] = field(default_factory=dict)

    def step(self, request, response, desired, memory):
        del request, response
        return desired, memory

    def effective_gain(self):
        return 0.0

    def secant_gain(self):
        return 0.0

    def largest_step(self):
        return math.inf

    def with_effective_gain(self, gain):
        del gain
        return self


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gain": "a"}, "ExternalPlant.gain: expected a number, got the text 'a'"),
        (
            {"gain": 1.0, "inner": fp.Sigmoid},
            "ExternalPlant.inner: expected a Deformation or None, got the class Sigmoid; write Sig",
        ),
        (
            {"gain": 1.0, "spans": {"a": (1.0, "b")}},
            r"ExternalPlant.spans\['a'\]\[1\]: expected a number, got the text 'b'",
        ),
        ({"gain": 1.0, "spans": {1: (1.0, 2.0)}}, "ExternalPlant.spans: name 1: expected a text, got 1"),
        ({"gain": True}, "expected a number, got True"),
        ({"gain": float("nan")}, "expected a number, got nan"),
        ({}, r"ExternalPlant needs gain; write ExternalPlant\(gain=\.\.\.\)"),
    ],
)
def test_a_class_of_another_distribution_is_checked_without_a_line_of_its_own(settings, message):
    with pytest.raises(InvalidField, match=message):
        ExternalPlant(**settings)
    whole: Any = np.int64(2)
    assert ExternalPlant(np.float64(1.0), ExternalPlant(2), {"a": (1, whole)}).gain == 1.0


def test_what_an_annotation_does_not_say_is_not_checked():
    class Open(Checked):
        def __init__(self, one, *more: int, two: NotThere = 3, **rest: int) -> None:  # type: ignore[name-defined]  # noqa: F821
            self.all = (one, more, two, rest)

    text: Any = "3"
    opened: Any = Open(1, 2, text, two=4, other=5)
    assert opened.all == (1, (2, "3"), 4, {"other": 5})


def test_a_contract_is_no_value():
    class Contract(Checked, ABC):
        @abstractmethod
        def act(self) -> None: ...

    with pytest.raises(InvalidField, match="Contract is a contract"):
        Contract()  # type: ignore[abstract]


def test_the_tuner_knows_whole_numbers_with_a_range():
    assert expects_whole_number(fp.Ipopt, "iterations")
    assert not expects_whole_number(fp.Ipopt, "accuracy")
    assert not expects_whole_number(fp.Ipopt, "nothing")


# --- The command line -------------------------------------------------------------------------------------------------


def test_an_error_inside_is_one_line_with_a_code_of_its_own(tmp_path, monkeypatch, capsys):
    """Exit code 1 is the answer no of a review."""
    monkeypatch.setattr("fpirhc.problem_files.problem_file.load_problem", lambda name: [][1])
    assert main(["review", "two_mass"]) == ExitCode.CRASHED
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "IndexError in test_mistakes.py" in said
    assert "report" in said
    assert main(["--debug", "review", "two_mass"]) == ExitCode.CRASHED
    assert "Traceback" in capsys.readouterr().err


def compared_with_own_metric(code: str) -> int:
    """The exit code of a comparison whose file has a metric with this body."""
    metric = f'metrics = (fp.Metric("mine", lambda problem, run: {code}),)\n'
    Path("mine.py").write_text(SOURCE + metric, encoding="utf-8")
    return main(["compare", "mine.py", "--no-compile", "--controllers", "CTC"])


def test_a_files_own_metric_that_breaks_leaves_the_rest_alone(tmp_path, monkeypatch, capsys):
    """The runs are done and shown; the metric is named with what happened."""
    monkeypatch.chdir(tmp_path)
    assert compared_with_own_metric('{}["there"]') == ExitCode.FINISHED
    printed = " ".join(capsys.readouterr().out.split())
    assert "metric 'mine' could not be computed (KeyError: 'there')" in printed


def test_a_files_own_code_that_ends_the_program_is_bad_input(tmp_path, monkeypatch, capsys):
    """It is no reason to end without a word."""
    monkeypatch.chdir(tmp_path)
    assert compared_with_own_metric("exit(0)") == ExitCode.BAD_INPUT
    said = capsys.readouterr().err
    assert "mine.py, line" in said
    assert "SystemExit: 0" in said
    assert "Traceback" not in said


# --- Random mistakes --------------------------------------------------------------------------------------------------


def test_the_file_without_mistakes_is_accepted(tmp_path):
    (tmp_path / "mine.py").write_text(SOURCE, encoding="utf-8")
    task = fp.load_problem(str(tmp_path / "mine.py"))
    assert [type(checked(task.problem, one)).__name__ for one in task.controllers.values()]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seeds", [range(120), pytest.param(range(1000, 11_000), marks=pytest.mark.slow)], ids=len)
def test_random_mistakes_never_end_in_a_raw_error(seeds, tmp_path, monkeypatch):
    raw = [raw_error(tmp_path / "mine.py", seed, monkeypatch) for seed in seeds]
    assert [one for one in raw if one] == []


def test_no_traceback_reaches_the_terminal(tmp_path):
    """The program itself, in a process of its own."""
    (tmp_path / "mine.py").write_text(SOURCE.replace("gain=-0.3", "gain='a'"), encoding="utf-8")
    words = [sys.executable, "-m", "fpirhc", "run", str(tmp_path / "mine.py"), "CTC"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert (
        "Affine.gain: expected a finite number other than zero (no adaptation is Identity()), got the text 'a'"
        in done.stderr
    )
    assert "Traceback" not in done.stderr
