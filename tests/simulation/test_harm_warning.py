"""A stepper of a controller that does better without its adaptation warns once; who ignores the warning pays nothing."""

import re
import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from helpers.plants import linear

import fpirhc as fp

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
    runs = [(p, c) for p in (short, own) for c in (GENTLE.with_deformation(fp.Identity()), GENTLE)]
    rms = [fp.measure(p, fp.simulate(p, c, seed=0, compiled=False)).rms_error["y"] for p, c in runs]
    assert [float(number) for number in found.groups()] == pytest.approx(rms, rel=6e-3)
    assert rms[1] > 2 * rms[0]
    assert rms[3] > rms[0]


@pytest.mark.parametrize("map_", [fp.ModelReferenced(fp.Affine(gain=-0.05)), fp.ModelReferenced(fp.Affine(gain=-0.8))])
def test_the_model_referenced_form_is_not_warned_of(map_):
    """It leaves an exact model alone, whatever its gain."""
    assert told(PROBLEM, replace(GENTLE, deformation=map_)) == []


def test_as_an_error_it_stops_the_build():
    """Who wants no such controller on a machine turns the warning into an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", fp.HarmfulAdaptation)
        with pytest.raises(fp.HarmfulAdaptation, match="adaptation does harm"):
            fp.Stepper(PROBLEM, GENTLE, compiled=False)
