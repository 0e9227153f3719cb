"""The null test: with the approximate model as plant there is nothing to adapt."""

from dataclasses import replace

import pytest
from helpers.plants import sine_of_three

import fpirhc as fp

LAW = fp.Exponential(rate=6.0)
CONTROLLERS = {"CTC": fp.ComputedTorque(LAW), "CTC+FPI": fp.ComputedTorque(LAW, fp.Sigmoid(gain=-0.5, scale=10.0))}


def compared(problem: fp.Problem, **settings):
    """A mass along a sine, 60 % heavier in the model."""
    task = replace(fp.load_problem("two_mass"), problem=problem, controllers=CONTROLLERS, headline=None, tuning={})
    return fp.compare(task, seed=0, compiled=False, **settings)


def test_the_null_test_is_the_pair_on_the_model_as_plant():
    """Nothing adapts alone, so there is nothing to test; with a pair it is that of the adaptive row."""
    problem = replace(sine_of_three(), duration=1.5)
    assert compared(problem, controllers=["CTC"])["CTC"].null is None
    rows = compared(problem)
    null, right = rows["CTC+FPI"].null, problem.with_exact(problem.plant.approximate)
    assert rows["CTC"].null is None
    for name, error in (("CTC", null.without), ("CTC+FPI", null.adapted)):
        run = fp.simulate(right, CONTROLLERS[name], seed=0, compiled=False)
        assert error == pytest.approx(fp.measure(right, run).rms_error, rel=1e-9, abs=1e-15)


def test_it_is_without_disturbances_and_of_at_most_2000_measured_cycles():
    """Disturbances are no error of the model; the run is shorter than a long task."""
    noisy = replace(sine_of_three(), disturbances={"u": fp.Noise(50.0)}, duration=30.0)
    calm = replace(noisy, disturbances={}, duration=noisy.measure_from + 2000 * noisy.period)
    found = [compared(one)["CTC+FPI"].null for one in (noisy, calm)]
    assert found[0].adapted == pytest.approx(found[1].adapted, rel=1e-12)
    assert noisy.cycles > 2 * calm.cycles
