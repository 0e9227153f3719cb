"""Believed states: what no sensor shows, by the model and by Kalman's filter; what cannot be known is named before the run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import abroad
import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from helpers.filters import extended_filter, runge_kutta
from helpers.plants import linear, pendulum

import fpirhc as fp
from fpirhc.contracts import Controller, StateObserver
from fpirhc.controllers.observed_state import unobservable_errors
from fpirhc.errors import FpirhcError, InvalidProblem, InvalidValue, NotSupported
from fpirhc.sensing.base import unobservable
from fpirhc.simulation.step_arguments import raw_measurements

CTC = fp.ComputedTorque(fp.Exponential(rate=0.5))
FPI = fp.ComputedTorque(fp.Exponential(rate=0.5), fp.Affine(gain=-0.5))
KALMAN = fp.KalmanFilter(measured={"C1": 1e-2}, noise={"C1": 0.3, "C2": 0.05, "C3": 0.05})


def infusion(observer: StateObserver, **changes: Any) -> fp.Problem:
    """Propofol: the plasma is measured, three compartments are not; time in minutes."""
    sensing = fp.Sensing({}, fp.VelocityDifference(), measured=["C1"], observer=observer)
    settings: dict[str, Any] = {"duration": 30.0, "measure_from": 5.0, "sensing": sensing}
    return replace(abroad.load("drug_infusion").problem, **(settings | changes))


def servo(observer: StateObserver, **changes: Any) -> fp.Problem:
    """A load on a flexible shaft: the motor's angle is measured, late by two cycles."""
    sensing = fp.Sensing({}, fp.PositionDifference(), measured=["motor"], observer=observer)
    late = fp.DeadTime(inputs={"V": 0.025}, measurement=0.02)
    settings: dict[str, Any] = {"duration": 1.0, "measure_from": 0.0, "sensing": sensing, "dead_time": late}
    return replace(abroad.load("flexible_servo").problem, **(settings | changes))


def swing(observer: StateObserver, believed: float = 1.0, **changes: Any) -> fp.Problem:
    """A pendulum whose angle is measured."""
    plant = pendulum(1.0, believed)
    settings: dict[str, Any] = {
        "plant": replace(plant, parameters={**plant.parameters, "l": fp.Parameter(0.6, 0.6, "m")}),
        "reference": fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)}),
        "start": {"angle": 0.1, "angle'": 1.6},
        "period": 0.01,
        "duration": 3.0,
        "sensing": fp.Sensing(
            {"angle": fp.Sensor(noise=fp.Noise(2e-3))}, fp.PositionDifference(), measured=["angle"], observer=observer
        ),
    }
    return fp.Problem(**(settings | changes))


TRACK = fp.ComputedTorque(fp.Exponential(rate=4.0))
ANGLE = fp.KalmanFilter(measured={"angle": 2e-3}, noise={"angle": 0.5}, start={"angle": 0.05, "angle'": 0.1})


def run(problem: fp.Problem, controller: Controller, seed: int = 0, compiled: bool = False) -> fp.Run:
    return fp.simulate(problem, controller, seed=seed, compiled=compiled)


# The model alone


@pytest.mark.parametrize("observer", [KALMAN], ids=str)
def test_samples_that_are_late_by_a_fraction_are_those_of_a_linear_model(observer):
    """Commands 1.25 and samples 2.4 cycles late: every believed state is interpolated as the measured one is, to rounding."""
    dead_time = fp.DeadTime(inputs={"u": 1.25 / 6}, measurement=2.4 / 6, before={"u": 9.0})
    result = run(infusion(observer, dead_time=dead_time, duration=15.0), fp.ExactModel(CTC))
    true = result["plant_state"]
    expected = 0.6 * true[1:-2] + 0.4 * true[:-3]
    np.testing.assert_allclose(result["state"][3:], expected, atol=1e-11)
    assert np.array_equal(result["state"][:3], np.tile(true[0], (3, 1)))
    assert np.ptp(expected, axis=0).min() > 0.1


# Kalman's filter


def test_it_is_the_extended_filter_of_the_books():
    """Against an independent recursion in numpy on the nonlinear pendulum, with a wrong mass, to 1e-10."""
    problem = swing(ANGLE, believed=1.3)
    result = run(problem, TRACK)

    def rate(x, u, w):
        return np.array([x[1], (u - 0.1 * x[1]) / (1.3 * 0.6**2) - 9.81 / 0.6 * np.sin(x[0]) + w[0]])

    step, start = runge_kutta(rate, problem.period), (problem.start_state, np.array([0.05, 0.1]))
    states, covariance = extended_filter(result, step, lambda x: x[:1], start, np.array([0.5]), 2e-3)
    np.testing.assert_allclose(result["state"], states, atol=1e-10)
    stepper = fp.Stepper(problem, TRACK, compiled=False)
    memory = stepper.start()
    for k in range(result.cycles):
        _, memory = stepper.step_measured(float(result.time[k]), raw_measurements(result)[k], memory)
    own = memory[stepper.memory.slice("observer_covariance")].reshape(2, 2)
    np.testing.assert_allclose(own, covariance, rtol=1e-10)
    assert np.linalg.eigvalsh(own).min() > 0


def test_on_a_linear_plant_it_becomes_the_stationary_filter():
    """Its covariance goes to the solution of the Riccati equation, from scipy, and its gain to that of a double integrator."""
    filter = fp.KalmanFilter(measured={"y": 1e-3}, noise={"y": 0.5}, start={"y": 1.0, "y'": 1.0})
    problem = fp.Problem(
        plant=linear(1.0, 1.0),
        reference=fp.Trajectory(lambda t: {"y": 0.3 * ca.sin(t)}),
        start={"y": 0.0},
        period=0.01,
        duration=6.0,
        sensing=fp.Sensing({}, fp.PositionDifference(), measured=["y"], observer=filter),
    )
    result, stepper = run(problem, TRACK), fp.Stepper(problem, TRACK, compiled=False)
    memory, h = stepper.start(), problem.period
    for k in range(result.cycles):
        _, memory = stepper.step_measured(float(result.time[k]), raw_measurements(result)[k], memory)
    a, b, c = np.array([[1, h], [0, 1]]), np.array([[h**2 / 2], [h]]), np.array([[1.0, 0.0]])
    prior = scipy.linalg.solve_discrete_are(a.T, c.T, 0.25 * b @ b.T, np.array([[1e-6]]))
    gain = prior @ c.T / (c @ prior @ c.T + 1e-6)
    own = memory[stepper.memory.slice("observer_covariance")].reshape(2, 2)
    np.testing.assert_allclose(own, prior - gain @ c @ prior, rtol=1e-8)


def test_its_covariance_is_that_of_its_errors():
    """With the right model and the stated noise, e' P^-1 e has the mean 2 of chi-squared, within four standard deviations.

    Errors of neighbouring cycles belong together, so 60 runs count with one cycle each. The disturbance is the filter's noise.
    """
    problem = swing(ANGLE, duration=0.6, disturbances={"angle": fp.Noise(0.5)})
    other = replace(problem, sensing=replace(problem.sensing, observer=replace(ANGLE, start={})))
    stepper = fp.Stepper(other, TRACK, compiled=False)
    simulator = fp.simulator(other, TRACK, compiled=False)
    squares = []
    for seed in range(60):
        result, memory = simulator.run(seed=seed), stepper.start()
        measured = raw_measurements(result)
        for k in range(result.cycles):
            _, memory = stepper.step_measured(float(result.time[k]), measured[k], memory)
        covariance = memory[stepper.memory.slice("observer_covariance")].reshape(2, 2)
        error = result["state"][-1] - result["plant_state"][-1]
        squares.append(error @ np.linalg.solve(covariance, error))
    assert np.mean(squares) == pytest.approx(2.0, abs=4 * 2 / np.sqrt(60))


def test_it_knows_the_angle_and_its_speed_better_than_differences_do():
    """From the noisy angle alone: a third of the sensor's error in the angle, a hundredth of the difference's in the speed."""
    filtered = run(swing(replace(ANGLE, noise={"angle": 0.02})), TRACK)
    plain = run(
        swing(ANGLE, sensing=fp.Sensing({"angle": fp.Sensor(noise=fp.Noise(2e-3))}, fp.PositionDifference())), TRACK
    )
    errors = [np.sqrt(np.mean((r["state"] - r["plant_state"])[50:] ** 2, axis=0)) for r in (filtered, plain)]
    assert errors[0][0] < errors[1][0] / 3
    assert errors[0][1] < errors[1][1] / 100


def test_an_accelerometer_may_correct_it():
    """A measured response has the model's Jacobian; the observer of the speed is then better than from the angle alone."""
    sensors = {"angle": fp.Sensor(noise=fp.Noise(2e-3)), "angle''": fp.Sensor(noise=fp.Noise(0.05))}
    with_it = replace(ANGLE, measured={"angle": 2e-3, "angle''": 0.05}, noise={"angle": 0.05})
    errors = []
    for filter in (with_it, replace(ANGLE, noise={"angle": 0.05})):
        sensing = fp.Sensing(sensors, fp.Measured(), measured=["angle", "angle''"], observer=filter)
        result = run(swing(filter, believed=1.0, sensing=sensing), TRACK)
        errors.append(np.sqrt(np.mean((result["state"] - result["plant_state"])[50:, 1] ** 2)))
    assert errors[0] < errors[1]


@pytest.mark.parametrize("observer", [KALMAN], ids=lambda b: type(b).__name__)
def test_adaptation_works_on_believed_states(observer):
    """The patient is another one than the model's: with FPI the plasma errs a tenth, though three compartments are believed."""
    errors = {}
    for name, controller in (("without", CTC), ("with", FPI)):
        problem = infusion(observer, duration=60.0, measure_from=20.0)
        errors[name] = fp.measure(problem, run(problem, controller)).rms_error["C1"]
    assert errors["with"] < 0.1 * errors["without"]


# What cannot be known is named


def test_unobservable_errors_are_those_of_the_books():
    """Random plants with 0 to 3 states that show nowhere, turned: the space is found, and Kalman's matrix has its rank."""
    random = np.random.default_rng(5)
    for hidden in range(4):
        a, c = random.normal(size=(6, 6)), random.normal(size=(2, 6))
        a[: 6 - hidden, 6 - hidden :], c[:, 6 - hidden :] = 0, 0
        turn = np.linalg.qr(random.normal(size=(6, 6)))[0]
        turned, shown = turn @ a @ turn.T, c @ turn.T
        basis = unobservable([turned], [shown])
        kalman = np.vstack([shown @ np.linalg.matrix_power(turned, k) for k in range(6)])
        assert basis.shape[1] == hidden == 6 - np.linalg.matrix_rank(kalman)
        planted = turn[:, 6 - hidden :]
        np.testing.assert_allclose(planted @ (planted.T @ basis), basis, atol=1e-9)


def test_motion_can_show_what_rest_hides():
    """Two instants with other slopes see together what each alone does not."""
    c = np.array([[1.0, 0.0, 0.0]])
    first, second = np.zeros((3, 3)), np.zeros((3, 3))
    first[0, 1], second[0, 2] = 1.0, 1.0
    assert unobservable([first], [c]).shape[1] == 1
    assert unobservable([second], [c]).shape[1] == 1
    assert unobservable([first, second], [c, c]).shape[1] == 0


def test_a_model_referenced_form_passes_the_null_test_on_believed_states():
    """With an exact model it changes nothing: the twin's response passes the same estimator."""
    problem = infusion(KALMAN, duration=10.0)
    referenced = fp.ComputedTorque(fp.Exponential(rate=0.5), fp.ModelReferenced(fp.Affine(gain=-0.5)))
    first, second = (run(problem, fp.ExactModel(c)) for c in (CTC, referenced))
    np.testing.assert_allclose(first["state"], second["state"], atol=1e-9)


def test_errors_that_decay_are_allowed_and_known():
    """The effect site follows the plasma and shows nowhere; its error decays with ke0 of the model, 0.26 / min."""
    free = unobservable_errors(infusion(KALMAN))
    assert free.states == ("Ce",)
    assert free.decays
    assert free.pole == pytest.approx(-0.26, rel=1e-9)


def test_a_state_that_cannot_be_observed_is_named_before_the_run():
    """From the load's speed nobody knows the angles: a turn of the whole servo shows nowhere and stays."""
    observer = fp.KalmanFilter(measured={"load'": 0.1}, noise={"motor": 1.0})
    problem = servo(observer, sensing=fp.Sensing({}, fp.PositionDifference(), measured=["load'"], observer=observer))
    with pytest.raises(
        NotSupported,
        match=r"KalmanFilter: load and motor cannot be observed along the reference from load'.*measure load",
    ):
        run(problem, CTC)


def shown(*measured: str, observer: StateObserver | None = None, **sensors: fp.Sensor) -> fp.Problem:
    """The infusion where this is measured."""
    return infusion(KALMAN, sensing=fp.Sensing(sensors, fp.VelocityDifference(), measured=measured, observer=observer))


BAD: dict[str, tuple[Callable[[], object], type[FpirhcError], str]] = {
    "unknown quantity": (
        lambda: shown("c1", observer=KALMAN),
        InvalidProblem,
        "measured: quantity 'c1'.*Did you mean 'C1'",
    ),
    "no observer": (
        lambda: shown("C1"),
        InvalidProblem,
        "VelocityDifference also needs C2, C3, Ce; measure it, or state how it is believed",
    ),
    "filter of what is not measured": (
        lambda: infusion(replace(KALMAN, measured={"C2": 0.1})),
        InvalidProblem,
        "no sensor shows 'C2'; those of Sensing\\(measured=...\\) are C1",
    ),
    "unknown noise": (
        lambda: infusion(replace(KALMAN, noise={"C22": 0.1})),
        InvalidProblem,
        "noise: coordinate 'C22'.*Did you mean 'C2'",
    ),
    "no noise": (lambda: fp.KalmanFilter(measured={"C1": 0.1}, noise={}), InvalidValue, "name at least one"),
}


@pytest.mark.parametrize("what", BAD)
def test_mistakes_are_named(what):
    make, kind, message = BAD[what]
    with pytest.raises(kind, match=f"(?s){message}"):
        make()
