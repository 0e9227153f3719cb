"""Dead time: where loops lose their stability, what pairing, prediction and a leak give back, and what each is told."""

import math
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from helpers import tasks
from helpers.iteration import Scalar, affine, iteration_radius
from helpers.plants import pendulum

import fpirhc as fp
from fpirhc.errors import InvalidValue


@pytest.mark.parametrize("form", [fp.Paired, partial(fp.Increment, uncertainty=0)])
@pytest.mark.parametrize("delay", [0, 1, 2, 3, 5, 10, 20])
def test_paired_is_stable_at_any_delay(form, delay):
    """D + 1 interleaved iterations: the rate is |1 - a|^(1/(d+1)), also at a = 1.9."""
    for gain in (0.5, 1.9):
        # The queue's own modes are zero; they form a Jordan block, whose computed eigenvalues are rounding^(1/size).
        assert iteration_radius(form(affine(gain), cycles=delay), delay) == pytest.approx(
            abs(1 - gain) ** (1 / (delay + 1)), abs=1e-6
        )
    assert iteration_radius(form(affine(2.05), cycles=delay), delay) > 1


def short(problem: fp.Problem, **changes) -> fp.Problem:
    return replace(problem, duration=0.3, measure_from=0.0, **changes)


two_mass = cache(lambda: short(tasks.two_mass.problem))
SIGMOID = fp.Sigmoid(gain=-0.5, scale=2.0)
LAW = fp.Exponential(rate=6.0)


def test_inputs_arrive_when_they_should():
    """Each input has its own delay; a fraction of a cycle is interpolated; queues begin with zero commands."""
    delayed = replace(two_mass(), dead_time=fp.DeadTime(inputs={"Q1": 3.25e-3, "Q2": 2e-3}))
    run = fp.simulate(delayed, fp.ComputedTorque(LAW), seed=0, compiled=False)
    sent, arrived = run["command"], run["arriving"]
    padded = np.vstack([np.zeros((4, 2)), sent])
    np.testing.assert_allclose(arrived[:, 0], 0.75 * padded[1:-3, 0] + 0.25 * padded[:-4, 0], 1e-12, equal_nan=False)
    np.testing.assert_array_equal(arrived[:, 1], padded[2:-2, 1])


def test_measurements_are_old():
    """The controller sees the state of 5 cycles ago (the start before that); the run is judged by the true one."""
    delayed = replace(two_mass(), dead_time=fp.DeadTime(measurement=5e-3))
    run = fp.simulate(delayed, fp.ComputedTorque(LAW, fp.Paired(SIGMOID, cycles=5)), seed=0, compiled=False)
    np.testing.assert_array_equal(run["state"][5:], run["plant_state"][:-5])
    np.testing.assert_array_equal(run["state"][:5], np.tile(delayed.start_state, (5, 1)))
    np.testing.assert_array_equal(run["realised"][5:], run["plant_realised"][:-5])
    np.testing.assert_allclose(run["true_error"], run["reference"][:, :2] - run["plant_state"][:, :2], atol=1e-14)
    assert fp.measure(delayed, run).rms_error["q1"] == pytest.approx(np.sqrt(np.mean(run["true_error"][:, 0] ** 2)))


def test_a_form_takes_all_dead_times_of_the_problem_or_none():
    """Late by 5 cycles of the measurement: the form knows it, and one with cycles of its own adds nothing to them."""
    delayed = replace(two_mass(), dead_time=fp.DeadTime(measurement=5e-3))
    forms = (fp.ModelReferenced(SIGMOID), fp.ModelReferenced(SIGMOID, cycles=5), fp.ModelReferenced(SIGMOID, cycles=0))
    runs = [fp.simulate(delayed, fp.ComputedTorque(LAW, form), seed=0, compiled=False) for form in forms]
    known, own, none = (run["command"] for run in runs)
    np.testing.assert_allclose(known, own, rtol=1e-9)
    assert not np.allclose(known, none)


def test_prediction_with_the_exact_model_undoes_the_dead_time():
    """The plant moves as without dead time, that much later, when it rests in between."""
    problem = fp.Problem(
        plant=pendulum(mass=1.0, believed=1.4),
        reference=fp.Trajectory(lambda t: {"angle": 0.4 + 0 * t}),
        start={"angle": 0.0},
        period=2e-3,
        duration=1.5,
    )
    law = fp.ComputedTorque(fp.Exponential(rate=5.0, integral=False))
    free = fp.simulate(problem, fp.ExactModel(law), seed=0, compiled=None)
    for dead_time in (fp.DeadTime(inputs={"torque": 0.1}), fp.DeadTime(inputs={"torque": 0.06}, measurement=0.04)):
        late = replace(problem, dead_time=dead_time)
        predicted = fp.Predicted(law, inputs=dead_time.inputs["torque"], measurement=dead_time.measurement)
        run = fp.simulate(late, fp.ExactModel(predicted), seed=0, compiled=None)
        measured_log = run["plant_state" if dead_time.measurement else "state"]
        shift = round(dead_time.inputs["torque"] / problem.period)
        np.testing.assert_allclose(measured_log[shift:], free["state"][:-shift], atol=2e-8)


def test_commands_on_their_way_at_the_start():
    """In steady motion with the right commands on their way nothing moves; predicted from them, nothing is corrected."""
    tanks = fp.load_problem("delayed_tanks")
    resting = replace(
        tanks.problem, reference=fp.Trajectory(lambda t: {"h2": 0.12 + 0 * t}), duration=20.0, measure_from=0.0
    )
    run = fp.simulate(resting, tanks.controllers["RHC exact model"], seed=0, compiled=False)
    np.testing.assert_allclose(run["state.h2"], 0.12, atol=1e-4)
    np.testing.assert_allclose(run["command"], 61.4, atol=0.5)


# Leaky pairing: stable for every dead time within the uncertainty, by the theorem, by the map itself, and on a plant


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


FASTEST = fp.Sigmoid(gain=-0.5, scale=20.0).with_effective_gain(1 / 1.5)  # the masses' ratio is the largest eigenvalue


@pytest.mark.parametrize("true", [2, 20, 48])
def test_delayed_mass_with_an_unknown_dead_time(true):
    """Predicted over half of the longest dead time the error is 6.1 to 6.3 mm wherever it is; at most 7.6 are allowed."""
    assert fp.Increment.within(FASTEST, 7) == fp.Increment(FASTEST, cycles=3.5, uncertainty=4)  # the middle of them
    dead_time = fp.DeadTime(inputs={"Q": true * tasks.delayed_mass.problem.period})
    problem = replace(tasks.delayed_mass.problem, dead_time=dead_time, limits=fp.Limits())
    law = fp.ComputedTorque(LAW, fp.Increment.within(FASTEST, 50))
    run = fp.simulate(problem, fp.Predicted(law, inputs=0.025), seed=0)
    assert fp.measure(problem, run).rms_error["q"] <= 7.6e-3


def test_a_dead_time_for_every_channel():
    """Two coordinates whose commands are 3 and 30 cycles late, each paired with its own; told of the shorter only it swings."""
    problem = replace(
        tasks.two_mass.problem, dead_time=fp.DeadTime(inputs={"Q1": 3e-3, "Q2": 3e-2}), limits=fp.Limits()
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
