"""A moving horizon of states: Kalman's filter where the model is linear, least squares of the books where it is not.

The batch reactor 2A -> B of Haseltine and Rawlings, Ind. Eng. Chem. Res. 44(8), 2005, starts at a wrong guess: an extended Kalman
filter goes to a negative pressure and stays there, a horizon with bounds comes to the true one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.optimize
from plants import linear, pendulum

import fpirhc as fp
from fpirhc.controllers.contract import Controller
from fpirhc.errors import FpirhcError, InvalidProblem, InvalidValue, NotSupported
from fpirhc.sensing.base import StateObserver
from fpirhc.simulation.step_arguments import raw_measurements

TRACK = fp.ComputedTorque(fp.Exponential(rate=4.0))
HALF: dict[str, Any] = {"measured": {"y": 1e-3}, "noise": {"y": 0.5}, "start": {"y": 1.0, "y'": 1.0}}
ANGLE: dict[str, Any] = {"measured": {"angle": 2e-3}, "noise": {"angle": 0.5}, "start": {"angle": 0.05, "angle'": 0.1}}


def sensed(name: str, deviation: float, observer: StateObserver) -> fp.Sensing:
    sensors = {name: fp.Sensor(noise=fp.Noise(deviation))}
    return fp.Sensing(sensors, fp.PositionDifference(), measured=[name], observer=observer)


def double(observer: StateObserver, **changes: Any) -> fp.Problem:
    """Y'' = u with y measured."""
    settings: dict[str, Any] = {"sensing": sensed("y", 1e-3, observer), "period": 0.01, "duration": 0.6}
    reference = fp.Trajectory(lambda t: {"y": 0.3 * ca.sin(t)})
    return fp.Problem(plant=linear(1.0, 1.0), reference=reference, start={"y": 0.0}, **(settings | changes))


def swing(observer: StateObserver, **changes: Any) -> fp.Problem:
    """A pendulum with a wrong mass whose angle is measured."""
    plant = pendulum(1.0, 1.3)
    settings: dict[str, Any] = {
        "plant": replace(plant, parameters={**plant.parameters, "l": fp.Parameter(0.6, 0.6, "m")}),
        "reference": fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)}),
        "start": {"angle": 0.1, "angle'": 1.6},
        "period": 0.02,
        "duration": 0.6,
        "sensing": sensed("angle", 2e-3, observer),
    }
    return fp.Problem(**(settings | changes))


def run(problem: fp.Problem, controller: Controller = TRACK, seed: int = 0, compiled: bool = False) -> fp.Run:
    return fp.simulate(problem, controller, seed=seed, compiled=compiled)


# A linear model


@pytest.mark.parametrize("late", [0.0, 0.024], ids=["at once", "2.4 cycles late"])
@pytest.mark.parametrize("window", [1, 9])
def test_for_a_linear_model_it_is_the_kalman_filter(window: int, late: float) -> None:
    """Whatever the window: the arrival cost has the filter's covariance. Also where the start is known and its covariance zero."""
    dead_time = fp.DeadTime(measurement=late)
    for start in (HALF["start"], {"y'": 0.5}):
        settings = {**HALF, "start": start}
        observers = fp.KalmanFilter(**settings), fp.MovingHorizonStates(**settings, window=window)
        one, other = (run(double(observer, dead_time=dead_time)) for observer in observers)
        np.testing.assert_allclose(other["state"], one["state"], atol=1e-9)
        assert np.ptp(one["state"], axis=0).min() > 0.1


def test_its_arrival_cost_is_the_filter_s() -> None:
    """After k cycles its covariance is the filter's prediction for the first sample of the window, k - N cycles in."""
    window, cycles = 6, 30
    problem = double(fp.MovingHorizonStates(**HALF, window=window))
    memory, stepper = replayed(problem, cycles)
    a, b, c = np.array([[1, 0.01], [0, 1]]), np.array([[0.5e-4], [0.01]]), np.array([[1.0, 0.0]])
    p = np.eye(2)
    for _ in range(cycles - window - 1):
        gain = p @ c.T / (c @ p @ c.T + 1e-6)
        p = a @ (p - gain @ c @ p) @ a.T + 0.25 * b @ b.T
    own = memory[stepper.memory.slice("observer_covariance")].reshape(2, 2)
    np.testing.assert_allclose(own, p, rtol=1e-9)


def replayed(problem: fp.Problem, cycles: int) -> tuple[np.ndarray, fp.Stepper]:
    """The memory after some cycles of a run, and its stepper."""
    result, stepper = run(problem), fp.Stepper(problem, TRACK, compiled=False)
    memory = stepper.start()
    for k in range(cycles):
        _, memory = stepper.step_measured(float(result.time[k]), raw_measurements(result)[k], memory)
    return memory, stepper


# A curved model: least squares by somebody else


class Window:
    """The least-squares problem of one window of the pendulum, in numpy: unknowns are its first state and its noises."""

    def __init__(self, observer: fp.MovingHorizonStates, memory: np.ndarray, stepper: fp.Stepper) -> None:
        def part(name: str) -> np.ndarray:
            return memory[stepper.memory.slice(name)]

        self.observer, count = observer, observer.window + 1
        self.states = part("observer_states").reshape(count, 2)
        self.noises = part("observer_noises")
        self.mean, self.covariance = part("observer_arrival"), part("observer_covariance").reshape(2, 2)
        rows = part("observer_samples").reshape(count, 4)
        assert (rows[:, :2] == 1).all()
        self.measured, self.commands = rows[:, 2], rows[:, 3]
        self.root = np.linalg.inv(np.linalg.cholesky(self.covariance))

    def advanced(self, x: Any, u: float, w: Any) -> Any:
        def rate(x: Any) -> Any:
            return np.array([x[1], (u - 0.1 * x[1]) / (1.3 * 0.6**2) - 9.81 / 0.6 * np.sin(x[0]) + w])

        h = 0.02
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        k4 = rate(x + h * k3)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def motion(self, unknown: np.ndarray) -> list[Any]:
        states = [unknown[:2]]
        for u, w in zip(self.commands[1:], unknown[2:], strict=True):
            states.append(self.advanced(states[-1], u, w))
        return states

    def residuals(self, unknown: np.ndarray) -> np.ndarray:
        """What least squares makes small: prior, noises, and errors of the samples."""
        angles = np.array([x[0] for x in self.motion(unknown)])
        parts = self.root @ (unknown[:2] - self.mean), unknown[2:] / 0.5, (self.measured - angles) / 2e-3
        return np.concatenate(parts)

    @property
    def own(self) -> np.ndarray:
        """The library's estimate of the unknowns."""
        return np.concatenate([self.states[0], self.noises])


def test_its_window_is_solved_as_by_scipy() -> None:
    """States and noises of a full window agree with `scipy.optimize.least_squares` from another guess, to 1e-8."""
    observer = fp.MovingHorizonStates(**ANGLE, window=8, iterations=8)
    window = Window(observer, *replayed(swing(observer), 25))
    guess = np.concatenate([window.mean, np.zeros(8)])
    best = scipy.optimize.least_squares(
        window.residuals, guess, xtol=1e-15, ftol=1e-15, gtol=1e-15, jac="3-point", x_scale="jac"
    )
    np.testing.assert_allclose(window.own, best.x, atol=1e-8 * np.abs(best.x).max())
    np.testing.assert_allclose(window.states, np.array(window.motion(best.x)), atol=1e-8)
    assert np.abs(window.noises).max() > 0.01


def test_a_bound_is_the_logarithm_that_it_says() -> None:
    """An angle that is believed to stay below .5 swings to .8: at the estimate the gradient of the whole cost vanishes."""
    observer = fp.MovingHorizonStates(**ANGLE, window=6, iterations=30, bounds={"angle": (-2.0, 0.5)}, barrier=0.5)
    window = Window(observer, *replayed(swing(observer, start={"angle": 0.45, "angle'": 0.0}), 22))

    def cost(unknown: np.ndarray) -> Any:
        angles = np.array([x[0] for x in window.motion(unknown)])
        logarithms = np.log(0.5 - angles) + np.log(angles + 2.0)
        return (window.residuals(unknown) ** 2).sum() - 2 * 0.5 * logarithms.sum()

    steps = 1e-30j * np.eye(8)
    gradient = np.array([cost(window.own + e).imag / 1e-30 for e in steps])
    plain = np.array([(window.residuals(window.own + e) ** 2).sum().imag / 1e-30 for e in steps])
    assert np.abs(gradient).max() < 1e-6 * np.abs(plain).max()
    assert window.measured.max() > 0.5 > window.states[:, 0].max()


def test_a_right_model_believes_what_is() -> None:
    """With the exact model, a known start and no noise the estimate is the plant's state, one Gauss-Newton step per sample."""
    observer = fp.MovingHorizonStates(measured={"angle": 2e-3}, noise={"angle": 0.5}, window=5)
    sensing = fp.Sensing({}, fp.PositionDifference(), measured=["angle"], observer=observer)
    result = run(swing(observer, sensing=sensing), fp.ExactModel(TRACK))
    np.testing.assert_allclose(result["state"], result["plant_state"], atol=1e-11)


# The reactor of Haseltine and Rawlings


def reactor() -> fp.Plant:
    """2A -> B in the gas phase; a pressure gauge shows the sum."""
    return fp.Plant.of_states(
        states={"A": "bar", "B": "bar"},
        inputs={"feed": "bar/s"},
        parameters={"k": fp.Parameter(0.16, 0.16, "1/bar/s")},
        rates=lambda x, u, p: {"A": -2 * p.k * x.A**2, "B": p.k * x.A**2 + u.feed},
        outputs={"P": fp.Output("bar", lambda x, p: x.A + x.B)},
    )


KNOWN: dict[str, Any] = {"measured": {"P": 0.1}, "noise": {"A": 1e-2, "B": 1e-2}, "start": {"A": 6.0, "B": 6.0}}
INSIDE = {"A": (0.0, np.inf), "B": (0.0, np.inf)}
PRESSURE = fp.ComputedTorque(fp.Exponential(rate=1.0))


def batch(observer: StateObserver) -> fp.Problem:
    """The batch of the paper: it starts at 3 and 1 bar and is believed at 0.1 and 4.5; the valve of the feed is shut."""
    return fp.Problem(
        plant=reactor(),
        reality=fp.Reality(reactor(), start={"A": 3.0, "B": 1.0}, integrator=fp.RungeKutta4(substeps=4)),
        reference=fp.Trajectory(lambda t: {"P": 2.5 + 1.5 * ca.exp(-t)}),
        start={"A": 0.1, "B": 4.5},
        period=0.1,
        duration=10.0,
        limits=fp.Limits(inputs={"feed": (0.0, 1e-9)}),
        sensing=sensed("P", 0.1, observer),
    )


def pressures(observer: StateObserver) -> list[fp.Run]:
    simulator = fp.simulator(batch(observer), PRESSURE, compiled=False)
    return [simulator.run(seed=seed) for seed in range(6)]


def test_a_kalman_filter_goes_to_a_negative_pressure() -> None:
    """As in the paper: after 10 s the pressure of A is believed at -3 to -2 bar, and it is 0.29."""
    for result in pressures(fp.KalmanFilter(**KNOWN)):
        assert result["plant_state.A"][-1] == pytest.approx(3 / (1 + 2 * 0.16 * 3 * 9.9), rel=1e-6)
        assert result["state.A"][-1] < -1


@pytest.mark.parametrize("window", [5, 10])
def test_a_moving_horizon_comes_to_the_true_pressure(window: int) -> None:
    """With six seeds and one step per sample: within .4 bar after 1 s, and within .02 bar of .29 after 10 s."""
    for result in pressures(fp.MovingHorizonStates(**KNOWN, window=window, bounds=INSIDE)):
        error = np.abs(result["state"] - result["plant_state"])
        assert error[0].max() > 2
        assert error[10:].max() < 0.4
        assert error[-1].max() < 0.02
        assert result["state"].min() > 0


class Batch:
    """The reactor outside, by its exact solution A(t) = 3 / (1 + 6 k t); its gauge shows the sum."""

    def reset(self, seed: int) -> np.ndarray:
        del seed
        return self.shown(0.0)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        del command
        return self.shown(time + 0.1)

    def shown(self, time: float) -> np.ndarray:
        a = 3 / (1 + 6 * 0.16 * time)
        return np.array([a + 1 + (3 - a) / 2])


def test_a_foreign_reactor_is_believed_alike() -> None:
    """The same batch as an object outside, of which nothing is known but its pressure: the same estimates, to its integrator."""
    problem = batch(fp.MovingHorizonStates(**KNOWN, window=5, bounds=INSIDE))
    foreign = replace(problem, reality=fp.ExternalPlant(Batch(), measures={"P": "bar"}))
    one, other = run(problem, PRESSURE, seed=3), run(foreign, PRESSURE, seed=3)
    np.testing.assert_allclose(other["state"], one["state"], atol=1e-5)
    assert abs(other["state.A"][-1] - 3 / (1 + 6 * 0.16 * 9.9)) < 0.02


def test_without_bounds_the_horizon_goes_astray_too() -> None:
    """What helps is the bound: a window alone goes behind zero, where the sum falls too, and finds no way back."""
    for result in pressures(fp.MovingHorizonStates(**KNOWN, window=10)):
        assert result["state.A"][-1] < -1


# One step with the controller


# What is refused


def turning(**changes: Any) -> StateObserver:
    return fp.MovingHorizonStates(**{**ANGLE, "window": 5, **changes})


SPEED = fp.MovingHorizonStates(measured={"y'": 0.1}, noise={"y": 0.5}, window=4)
WRONG: dict[str, tuple[Callable[[], object], type[FpirhcError], str]] = {
    "window": (lambda: turning(window=0), InvalidValue, r"window: expected a whole number from 1 to 500"),
    "iterations": (lambda: turning(iterations=51), InvalidValue, r"iterations: expected a whole number from 1 to 50"),
    "nothing measured": (lambda: turning(measured={}), InvalidValue, r"MovingHorizonStates\(measured={}\): name at least one"),
    "bounds": (lambda: turning(bounds={"angle": (1.0, -1.0)}), InvalidValue, r"are \(1.0, -1.0\); write lower < upper"),
    "name": (lambda: swing(turning(bounds={"angel": (-1.0, 1.0)})), InvalidProblem, "bounds: state 'angel' is unknown"),
    "not measured": (lambda: swing(turning(measured={"angle'": 0.1})), InvalidProblem, "no sensor shows 'angle''"),
    "start outside": (
        lambda: run(swing(turning(bounds={"angle": (0.1, 2.0)}))),
        InvalidProblem,
        "'angle' starts at 0.1, and its bounds are 0.1 and 2; start inside",
    ),
    "not observed": (
        lambda: run(double(SPEED, sensing=fp.Sensing({}, fp.VelocityDifference(), measured=["y'"], observer=SPEED))),
        NotSupported,
        "MovingHorizonStates: y cannot be observed along the reference from y'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_mistakes_are_named(what: str) -> None:
    make, kind, message = WRONG[what]
    with pytest.raises(kind, match=f"(?s){message}"):
        make()
