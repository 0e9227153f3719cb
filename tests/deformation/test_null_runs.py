"""The null test: with the approximate model as plant there is nothing to adapt."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plants import linear, sine_of_three

import fpirhc as fp
from fpirhc.problem_files.problem_file import Task
from fpirhc.simulation.model_as_plant import CYCLES, ModelAsPlant
from fpirhc.simulation.simulate import simulator
from fpirhc.studies.comparison.changes import Outcome
from fpirhc.studies.comparison.compare import compare
from fpirhc.studies.comparison.pairwise import null_test
from fpirhc.summary import in_percent

PLAIN = fp.ComputedTorque(fp.Exponential(rate=6.0))
ONE = {"y": 1.0}


def problem(**changes) -> fp.Problem:
    """A mass along a sine, 60 % heavier in the model."""
    return replace(sine_of_three(), **changes)


def null_of(adaptive: fp.ComputedTorque, cured: float = 1.0, **changes):
    """The null test of this controller beside the one without adaptation."""
    task = problem(**changes)
    plain, adapting = (simulator(task, c, compiled=False) for c in (PLAIN, adaptive))
    return null_test(ModelAsPlant(task, seed=0), (plain, adapting), ("CTC", "CTC+FPI"), ONE, cured={"y": cured})


def rms(plant: fp.Plant, controller: fp.ComputedTorque) -> float:
    """The rms error of a run of its own, on a problem of its own."""
    task = problem(plant=plant)
    return fp.measure(task, fp.simulate(task, controller, seed=0, compiled=False)).rms_error["y"]


SIGMOID = fp.Sigmoid(gain=-0.5, scale=10.0)


def test_it_is_the_run_on_the_approximate_plant():
    """The same loops with other exact parameters give what a problem with an exact model gives; the disturbance is left out."""
    null = null_of(fp.ComputedTorque(PLAIN.tracking, SIGMOID), disturbances={"u": fp.Step(at=0.5, size=4.0)})
    exact = linear(1.0, 1.0)
    assert null.before["y"] == pytest.approx(rms(exact, PLAIN), rel=1e-9)
    assert null.after["y"] == pytest.approx(rms(exact, fp.ComputedTorque(PLAIN.tracking, SIGMOID)), rel=1e-9)
    assert "(the approximate model as plant, no disturbance)" in null.text


def test_a_form_that_leaves_an_exact_model_alone_passes():
    """The model-referenced form compares with the model's own response, and there is no difference to adapt to."""
    null = null_of(fp.ComputedTorque(PLAIN.tracking, fp.ModelReferenced(SIGMOID)))
    assert null.outcome is Outcome.NO_DIFFERENCE
    assert null.passed
    assert not null.harmful
    assert "passed, CTC+FPI is not worse than CTC" in null.text


def test_an_own_error_is_judged_by_the_error_that_it_removes():
    """The plain form makes a small error; it is harmless beside 1 m, and harmful beside a tenth of itself."""
    adaptive = fp.ComputedTorque(PLAIN.tracking, replace(SIGMOID, gain=-0.05))
    harmless = null_of(adaptive)
    assert not harmless.passed
    assert not harmless.harmful
    assert "makes a small error of its own" in harmless.text
    harmful = null_of(adaptive, cured=harmless.after["y"] / 10)
    assert harmful.harmful
    assert "failed, CTC+FPI is worse than CTC although there is nothing to adapt" in harmful.text


def test_what_it_adds_is_judged_by_the_range_of_the_run_as_in_a_review():
    """Ten times the error of the wrong model is no harm where it is a ten-thousandth of the way that the mass has come."""
    law, far = fp.ComputedTorque(PLAIN.tracking, replace(SIGMOID, gain=-0.05)), {"y": 50.0, "y'": 3.0}
    near, distant = (
        null_of(law, cured=1e-6, start=start, duration=6.0, measure_from=4.0) for start in ({"y": 0.0, "y'": 3.0}, far)
    )
    assert near.harmful
    assert distant.after["y"] == pytest.approx(near.after["y"], rel=0.1)
    assert not distant.harmful
    assert distant.text.endswith("; it adds less than 0.1 % of the range of the run.")


def test_a_null_test_of_rows_mostly_at_a_limit_is_not_informative():
    """The sine needs 14.4 N of the model; with 2 N both commands stand at a limit, where nothing can be told of adaptation."""
    narrow = fp.Limits(inputs={"u": (-2.0, 2.0)})
    null = null_of(fp.ComputedTorque(PLAIN.tracking, replace(SIGMOID, gain=-0.05)), limits=narrow)
    task = problem(plant=linear(1.0, 1.0), limits=narrow)
    share = fp.measure(task, fp.simulate(task, PLAIN, seed=0, compiled=False)).values["at_limit"][""]
    assert share > 0.9
    assert null.text.startswith(
        "Null test: not informative, the command stands at a limit in most cycles (that of CTC in "
    )
    assert f"that of CTC in {in_percent(share)}" in null.text
    assert null.outcome is Outcome.NOT_COMPARABLE
    assert not null.harmful


def test_what_does_not_finish():
    """A loop that diverges where the plain one finishes has failed; where the plain one diverges nothing is shown."""
    wild = fp.ComputedTorque(PLAIN.tracking, fp.BeyondLimit(fp.Affine(gain=-60.0)))
    good = fp.ComputedTorque(PLAIN.tracking, SIGMOID)
    task = problem(duration=2.0, measure_from=0.1)
    loops = [simulator(task, c, compiled=False) for c in (good, wild)]
    told: list[tuple[int, int]] = []
    model = ModelAsPlant(task, seed=0, progress=lambda done, total: told.append((done, total)))
    lost = null_test(model, (loops[0], loops[1]), ("CTC", "CTC+FPI"), ONE, cured=ONE)
    assert np.isnan(lost.after["y"])
    assert lost.harmful
    assert (2000, 4000) in told  # half is done after the first of both runs
    assert "failed, CTC+FPI does not finish where CTC does" in lost.text
    back = null_test(model, (loops[1], loops[0]), ("CTC", "CTC+FPI"), ONE, cured=ONE)
    assert back.outcome is Outcome.NOT_COMPARABLE
    assert not back.harmful


def test_a_long_run_is_cut():
    """The price of a test does not grow with the length of the run."""
    null = null_of(fp.ComputedTorque(PLAIN.tracking, SIGMOID), duration=10.0)
    assert null.cycles == 1000 + CYCLES


def test_a_comparison_without_a_pair_has_none():
    """Nothing adapts, so there is nothing to test; with a pair it is in the result."""
    controllers = {"CTC": PLAIN, "CTC+FPI": fp.ComputedTorque(PLAIN.tracking, SIGMOID)}
    task = Task("case", Path("case.py"), "", "", problem(duration=1.5), controllers)
    assert compare(task, seed=0, controllers=["CTC"], compiled=False).null is None
    null = compare(task, seed=0, compiled=False).null
    assert null is not None
    assert null.pair == ("CTC", "CTC+FPI")
