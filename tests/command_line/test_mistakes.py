"""Typical mistakes in problem files: each is refused with its file and line, its cause and how to mend it, and without a traceback.

Each case changes one place of a correct file. What stands in a message is what a user needs: the line of the change, what is wrong
there, and what to write instead. `test_wrong_files` has the mistakes of people who come from other tools.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
import pytest
from mutated_problems import SOURCE
from raw_errors import raw_error

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.controllers.check import checked
from fpirhc.errors import InvalidField
from fpirhc.fields.checked import Checked, expects_whole_number
from fpirhc.symbolic.live import SymbolicNumber

# The name of a mistake, the old piece of the correct file and the new one, and what must be said: the cause and the mend.


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
