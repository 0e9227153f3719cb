"""Leaky pairing: stable for every dead time within the uncertainty, by the theorem, by the map itself, and on a plant."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import tasks
from helpers.iteration import Scalar, affine, iteration_radius

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidValue


def radius(product: float, pole: float, believed: int, true: int) -> float:
    """Largest root of 1 - p / z = (1 - p) (z^-(d+1) - g z^-(d'+1))."""
    size = max(believed, true) + 2
    row = np.zeros(size)
    row[0], row[1] = 1.0, -pole
    row[believed + 1] -= 1 - pole
    row[true + 1] += (1 - pole) * product
    return float(np.abs(np.roots(row)).max())


def least_pole(product: float, wrong: int) -> float:
    """(2 c + 1 - sqrt(4 c + 1)) / (2 c) with c = g (2 + g) m^2 / 4."""
    c = product * (2 + product) * wrong**2 / 4
    return (2 * c + 1 - math.sqrt(4 * c + 1)) / (2 * c)


@pytest.mark.parametrize("form", [fp.Increment, fp.ModelReferenced])
def test_the_default_leak_damps_every_dead_time_within_the_uncertainty(form):
    """Random dead times up to 60 cycles, wrong by up to 7, products up to 1.98: the pole is a little above the theorem's bound."""
    random = np.random.default_rng(8)
    for k in range(200):
        believed, wrong = int(random.integers(7, 61)), int(random.integers(1, 8))
        true = believed + int(random.integers(-wrong, wrong + 1))
        product = float(random.uniform(0.02, 1.98))
        deformation = form(affine(product), cycles=believed, uncertainty=wrong)
        pole = min(1.01 * (least := least_pole(max(product, 1.0), wrong)) + 1e-3, (1 + least) / 2)
        assert radius(product, pole, believed, true) < 1
        if k < 12:  # by the map itself, whose matrix is large
            assert iteration_radius(deformation, true) == pytest.approx(radius(product, pole, believed, true), abs=1e-6)


def test_without_a_leak_one_cycle_is_too_much():
    """A tenth of the dead time is tolerated by default, at least a cycle."""
    for cycles, same in ((30, 3), (20, 2), (1, 1), (0, 0)):  # a tenth of 30 is a little more than 3 in floating point
        assert first_step(cycles, None) == first_step(cycles, same)
    assert first_step(20, None) < first_step(1, None) < first_step(0, None) == 1.0
    assert first_step(200, 100) == pytest.approx((1 - least_pole(1.0, 100)) / 2)  # however wrong, below one
    assert iteration_radius(fp.Increment(affine(1.0), cycles=20, uncertainty=0), 21) > 1
    # The bound is tight for one cycle: a pole 1 % below it leaves some dead time unstable.
    pole = 0.99 * least_pole(1.0, 1)
    assert max(radius(1.0, pole, d, d + wrong) for d in (40, 80, 120) for wrong in (-1, 1)) > 1


def first_step(cycles, uncertainty):
    step = Scalar(fp.Increment(affine(1.0), cycles=cycles, uncertainty=uncertainty))
    for _ in range(cycles + 2):
        step(0.0, 0.0, 0.0)
    return -step(0.0, 1.0, 0.0)


LAW = fp.Exponential(rate=6.0)
FASTEST = fp.Sigmoid(gain=-0.5, scale=20.0).with_effective_gain(1 / 1.5)  # the masses' ratio is the largest eigenvalue


def unknown_rms(true: int, deformation: Deformation, predicted: float = 0.025) -> float:
    """Rms error of the delayed mass whose dead time is only known to be at most 50 cycles."""
    dead_time = fp.DeadTime(inputs={"Q": true * tasks.delayed_mass.problem.period})
    problem = replace(tasks.delayed_mass.problem, dead_time=dead_time, limits=fp.Limits())
    law = fp.ComputedTorque(LAW, deformation)
    run = fp.simulate(problem, fp.Predicted(law, inputs=predicted) if predicted else law, seed=0)
    return fp.measure(problem, run).rms_error["q"]


COVERING = fp.Increment.within(FASTEST, 50)


def test_within_is_in_the_middle_of_all_dead_times_up_to_the_longest():
    assert fp.Increment.within(FASTEST, 7) == fp.Increment(FASTEST, cycles=3.5, uncertainty=4)


@pytest.mark.parametrize("true", [2, 20, 48])
def test_delayed_mass_with_an_unknown_dead_time(true):
    """Predicted over half of the longest dead time the error is 6.1 to 6.3 mm wherever it is; at most 7.6 are allowed."""
    assert unknown_rms(true, COVERING) <= 7.6e-3


def test_a_dead_time_for_every_channel():
    """Two coordinates whose commands are 3 and 30 cycles late, each paired with its own; told of the shorter only it swings."""
    problem = replace(
        fp.load_problem("two_mass").problem, dead_time=fp.DeadTime(inputs={"Q1": 3e-3, "Q2": 3e-2}), limits=fp.Limits()
    )
    sigmoid, errors = fp.Sigmoid(gain=-1.5, scale=50.0), {}
    forms = {
        "none": fp.Identity(),
        "own": fp.Increment(sigmoid, cycles=(3, 30)),
        "both the shorter": fp.Increment(sigmoid, cycles=3),
        "own, model": fp.ModelReferenced(sigmoid, cycles=(3, 30)),
    }
    for name, deformation in forms.items():
        run = fp.simulate(problem, fp.ComputedTorque(LAW, deformation), seed=0)
        errors[name] = max(fp.measure(problem, run).rms_error.values())
    assert max(errors["own"], errors["own, model"]) < 0.1 * errors["none"]
    assert not errors["both the shorter"] < 10 * errors["own"]


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (
            lambda: fp.Increment(affine(0.5), cycles=4, uncertainty=5),
            r"Increment\(uncertainty=5\): expected whole cycles from 0 to 4",
        ),
        (lambda: fp.ModelReferenced(affine(0.5), cycles=2, uncertainty=3), "expected whole cycles from 0 to 2"),
        (lambda: fp.ModelReferenced(affine(0.5), measurement=0.5), "late by whole control cycles; give 0 or 1 for 0.5"),
        (lambda: fp.ModelReferenced(affine(0.5), cycles=(1, 2.5)), "give 2 or 3 for 2.5"),
        (lambda: fp.Increment(affine(0.5), cycles=(4, 2), uncertainty=3), "from 0 to 2"),
        (lambda: fp.Increment(affine(0.5), cycles=4, pole=1.0), "Increment.pole: expected a number from 0"),
        (lambda: fp.Increment.within(affine(0.5), -1), r"Increment.within\(most=-1\): expected a dead time between 0"),
        (lambda: fp.Increment(affine(0.5), cycles=()), "or a tuple with one for every controlled coordinate"),
        (lambda: fp.ModelReferenced(affine(0.5), cycles=(900, 300), measurement=200), "between 0 and 1000"),
    ],
)
def test_bad_settings(build, sentence):
    with pytest.raises(InvalidValue, match=sentence):
        build()
