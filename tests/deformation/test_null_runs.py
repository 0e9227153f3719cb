"""The null test: with the approximate model as plant there is nothing to adapt."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from plants import sine_of_three

import fpirhc as fp
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.comparison.compare import compare

PLAIN = fp.ComputedTorque(fp.Exponential(rate=6.0))


def problem(**changes) -> fp.Problem:
    """A mass along a sine, 60 % heavier in the model."""
    return replace(sine_of_three(), **changes)


SIGMOID = fp.Sigmoid(gain=-0.5, scale=10.0)


def test_a_comparison_without_a_pair_has_none():
    """Nothing adapts, so there is nothing to test; with a pair it is in the result."""
    controllers = {"CTC": PLAIN, "CTC+FPI": fp.ComputedTorque(PLAIN.tracking, SIGMOID)}
    task = Task("case", Path("case.py"), "", "", problem(duration=1.5), controllers)
    assert compare(task, seed=0, controllers=["CTC"], compiled=False).null is None
    null = compare(task, seed=0, compiled=False).null
    assert null is not None
    assert null.pair == ("CTC", "CTC+FPI")
