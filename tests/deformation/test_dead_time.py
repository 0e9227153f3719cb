"""Dead time: where loops lose their stability, and what pairing, prediction and an estimate give back."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from helpers.iteration import affine, iteration_radius
from helpers.plants import pendulum

import fpirhc as fp

DELAYS = (0, 1, 2, 3, 5, 10, 20)


@pytest.mark.parametrize("form", [fp.Paired, partial(fp.Increment, uncertainty=0)])
@pytest.mark.parametrize("delay", DELAYS)
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


two_mass = cache(lambda: short(fp.load_problem("two_mass").problem))
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
