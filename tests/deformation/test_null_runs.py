"""The null test: with the approximate model as plant there is nothing to adapt."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.plants import sine_of_three

import fpirhc as fp
from fpirhc import compare
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.problem_files.problem_file import Task

PLAIN = fp.ComputedTorque(fp.Exponential(rate=6.0))


def problem(**changes) -> fp.Problem:
    """A mass along a sine, 60 % heavier in the model."""
    return replace(sine_of_three(), **changes)


SIGMOID = fp.Sigmoid(gain=-0.5, scale=10.0)


def test_a_comparison_without_a_pair_has_none():
    """Nothing adapts, so there is nothing to test; with a pair it is that of the adaptive row, on the model as plant."""
    controllers = {"CTC": PLAIN, "CTC+FPI": fp.ComputedTorque(PLAIN.tracking, SIGMOID)}
    task = Task("case", Path("case.py"), "", "", problem(duration=1.5), controllers)
    assert compare(task, seed=0, controllers=["CTC"], compiled=False)["CTC"].null is None
    rows = compare(task, seed=0, compiled=False)
    null, plant = rows["CTC+FPI"].null, task.problem.plant
    assert rows["CTC"].null is None
    right = replace(task.problem, plant=with_exact_parameters(plant, plant.approximate))
    for name, error in (("CTC", null.without), ("CTC+FPI", null.adapted)):
        run = fp.simulate(right, controllers[name], seed=0, compiled=False)
        assert error == pytest.approx(fp.measure(right, run).rms_error, rel=1e-9, abs=1e-15)


def test_the_null_test_is_without_disturbances_and_of_at_most_2000_measured_cycles():
    """Disturbances are no error of the model; the run is shorter than a long task."""
    noisy = problem(disturbances={"u": fp.Noise(50.0)}, duration=30.0)
    calm = replace(noisy, disturbances={}, duration=noisy.measure_from + 2000 * noisy.period)
    controllers = {"CTC": PLAIN, "CTC+FPI": fp.ComputedTorque(PLAIN.tracking, SIGMOID)}
    found = [
        compare(Task("case", Path("case.py"), "", "", one, controllers), seed=0, compiled=False)["CTC+FPI"].null
        for one in (noisy, calm)
    ]
    assert found[0].adapted == pytest.approx(found[1].adapted, rel=1e-12)
    assert noisy.cycles > 2 * calm.cycles
