"""A stepper of a controller that does better without its adaptation warns once; who ignores the warning pays nothing."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from helpers.plants import linear

import fpirhc as fp
from fpirhc.controllers.contract import without_deformation
from fpirhc.export.lab import lab
from fpirhc.simulation.trials import ErrorPair

PROBLEM = fp.Problem(
    plant=linear(1.02, 1.0),
    reference=fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}),
    start={"y": 0.0, "y'": 3.0},
    period=5e-3,
    duration=4.0,
    measure_from=1.0,
)
GENTLE = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.05))
TEXT = (
    r"ComputedTorque: adaptation does harm, by runs of 300 cycles: on the plant the rms error of y is (\S+) m without adaptation, "
    r"(\S+) m with it; on its own model, with nothing to adapt the rms error of y is (\S+) m without adaptation, (\S+) m with it\. "
)


def told(problem: fp.Problem, controller) -> list[str]:
    """Texts of the warnings of one stepper, which then steps."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stepper = fp.Stepper(problem, controller, compiled=False)
        memory = stepper.start()
        for k in range(3):
            _, memory = stepper.step(k * problem.period, problem.start_state, np.zeros(1), memory)
    assert all(one.category is fp.HarmfulAdaptation for one in caught)
    assert all(one.filename == __file__ for one in caught)
    return [str(one.message) for one in caught]


def test_a_gentle_plain_form_is_warned_of_once_with_its_numbers():
    """The numbers are those of runs of 300 cycles, half of which count."""
    [text] = told(PROBLEM, GENTLE)
    found = re.search(TEXT, text)
    assert found
    short = replace(PROBLEM, duration=1.5, measure_from=0.75)
    own = replace(short, plant=linear(1.02, 1.02))
    runs = [(p, c) for p in (short, own) for c in (without_deformation(GENTLE), GENTLE)]
    rms = [fp.measure(p, fp.simulate(p, c, seed=0, compiled=False)).rms_error["y"] for p, c in runs]
    assert [float(number) for number in found.groups()] == pytest.approx(rms, rel=6e-3)
    assert rms[1] > 2 * rms[0]
    assert rms[3] > rms[0]


@pytest.mark.parametrize("map_", [fp.ModelReferenced(fp.Affine(gain=-0.05)), fp.ModelReferenced(fp.Affine(gain=-0.8))])
def test_the_model_referenced_form_is_not_warned_of(map_):
    """It leaves an exact model alone, whatever its gain."""
    assert told(PROBLEM, replace(GENTLE, deformation=map_)) == []


@pytest.mark.parametrize(
    "build", [lambda *pair: fp.Stepper(*pair, compiled=False), lambda p, c: lab.make_lab("", "", "", p, {"CTC": c})]
)
def test_as_an_error_it_stops_the_build(build, monkeypatch):
    """Who wants no such controller on a machine, or in a lab, turns the warning into an error."""
    monkeypatch.setattr(lab, "package", lambda *_: None)
    with warnings.catch_warnings():
        warnings.simplefilter("error", fp.HarmfulAdaptation)
        with pytest.raises(fp.HarmfulAdaptation, match="adaptation does harm"):
            build(PROBLEM, GENTLE)


@pytest.mark.parametrize(
    ("without", "adapted", "passes", "fails", "sentence"),
    [
        (0.1, math.inf, False, True, "the rms error of y is 0.1 m without adaptation, a run that ends early with it"),
        (math.inf, 0.1, True, False, "the run without adaptation ends early, and with it the rms error of y is 0.1 m"),
        (math.inf, math.inf, False, False, "the run without adaptation ends early, and so does the one with it"),
    ],
)
def test_where_the_plant_is_lost_anyway_adaptation_does_no_harm(without, adapted, passes, fails, sentence):
    """It is harm to lose a run that finishes without adaptation; where both are lost nothing speaks for it or against it."""
    pair = ErrorPair({"y": without}, {"y": adapted}, {"y": 1.0}, {"y": "m"})
    assert (pair.passes, pair.fails, pair.sentence) == (passes, fails, sentence)
