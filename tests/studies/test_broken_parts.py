"""A question, a metric or a part of a comparison that breaks is told by its name, and the rest is there."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from helpers import tasks

import fpirhc as fp
from fpirhc.simulation import simulate as simulating
from fpirhc.studies.comparison import compare as comparing

compared = cache(lambda: {name: tasks.two_mass.controllers[name] for name in ("CTC", "CTC+FPI (eq 6)")})
brief = cache(lambda: replace(tasks.two_mass.problem, duration=0.05, measure_from=0.0, horizon=None, cost=None))


def task(**changes):
    """Computed torque without and with adaptation, for 50 cycles."""
    small: dict[str, Any] = {
        "problem": brief(),
        "controllers": compared(),
        "headline": tuple(compared()),
        "pictures": (),
    }
    return replace(tasks.two_mass, **{**small, **changes})


def breaks(*_arguments, **_named):
    """What numpy does with a matrix that is not finite."""
    raise np.linalg.LinAlgError("Array must not contain infs or NaNs")


def test_a_broken_metric_is_told_by_its_name():
    """The other metrics have their numbers, in `measure` and in a comparison."""
    mine = fp.Metric("mine", lambda problem, run: 1 / 0)
    rms = fp.Metric("largest", lambda problem, run: float(np.abs(run["error"]).max()))
    run = fp.simulate(brief(), compared()["CTC"], seed=0, compiled=False)
    metrics = fp.measure(brief(), run, [mine, rms])
    assert metrics["largest"][""] > 0
    assert metrics["mine"] == {}
    [sentence] = metrics.broken.values()
    assert sentence.startswith("metric 'mine' could not be computed (ZeroDivisionError: division by zero)")


@pytest.mark.parametrize(
    ("part", "name"),
    [("_cycle_time", "the time of a cycle"), ("_contraction", "the contraction"), ("errors_of", "the null test")],
)
def test_a_part_of_a_comparison_that_breaks_loses_no_run(part, name, monkeypatch):
    """The runs and their metrics are there, and the notes name the part."""
    monkeypatch.setattr(comparing, part, breaks)
    result = fp.compare(task(), seed=0, compiled=None)
    assert [(e.run.cycles, e.run.compiled) for e in result.entries] == [
        (50, False),
        (50, False),
    ]  # too short for a compiler
    assert all(e.metrics.rms_error["q1"] > 0 for e in result.entries)
    assert any(note.startswith(f"{name} could not be computed (LinAlgError") for note in result.entries[1].notes)


def test_a_signal_that_breaks_after_the_run_does_not_lose_it(monkeypatch):
    """The run has its own signals, and says which one is missing."""
    monkeypatch.setattr(simulating, "_contraction", breaks)
    run = fp.simulate(brief(), compared()["CTC+FPI (eq 6)"], seed=0, compiled=False)
    assert run.cycles == 50
    assert "contraction" not in run.layout
    [sentence] = cast(list[str], run.settings["broken"])
    assert sentence.startswith("the signal 'contraction' could not be computed (LinAlgError")
