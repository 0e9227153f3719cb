"""Believed states: what no sensor shows, by the model and by Kalman's filter of the books; what cannot be known is named."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import abroad
import casadi as ca
import numpy as np
import pytest
from helpers.on_problem import named
from helpers.plants import pendulum, sine_of_three, swing
from helpers.plants import simulated as run
from helpers.replay import samples

import fpirhc as fp
from fpirhc.conformance import check_observer, examples
from fpirhc.contracts import StateObserver
from fpirhc.errors import NotSupported

State = Any


def runge_kutta(rate: Callable[[State, Any, State], State], h: float) -> Callable[[State, Any, State], State]:
    """The classical method's step (x, u, w) -> x of a rate."""

    def step(x: State, u: Any, w: State) -> State:
        k1 = rate(x, u, w)
        k2 = rate(x + h / 2 * k1, u, w)
        k3 = rate(x + h / 2 * k2, u, w)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u, w))

    return step


def slope(function: Callable[[State], State], at: np.ndarray) -> np.ndarray:
    """The Jacobian of a real-analytic function."""
    return np.column_stack([np.atleast_1d(function(at + 1e-30j * e)).imag / 1e-30 for e in np.eye(at.size)])


def extended_filter(
    result: fp.Run,
    step: Callable[[State, Any, State], State],
    shown: Callable[[State], State],
    start: tuple[np.ndarray, np.ndarray],
    noise: np.ndarray,
    measured: float,
) -> tuple[np.ndarray, np.ndarray]:
    """States of every cycle and the last covariance, from the raw measurements and commands of a run."""
    x, p, states = start[0], np.diag(start[1]) ** 2, []
    for k, sample in enumerate(samples(result)):
        x, p = _predicted(step, x, p, result["command"][k - 1, 0], noise) if k else (x, p)
        c = slope(shown, x)
        gain = p @ c.T / (c @ p @ c.T + measured**2)
        x, p = x + gain @ (sample - shown(x)), p - gain @ c @ p
        states.append(x)
    return np.array(states), p


def _predicted(
    step: Callable[[State, Any, State], State], x: np.ndarray, p: np.ndarray, u: float, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    still = np.zeros(noise.size)
    a, b = slope(lambda z: step(z, u, still), x), slope(lambda w: step(x, u, w), still)
    return step(x, u, still), a @ p @ a.T + b @ np.diag(noise) ** 2 @ b.T


BELIEFS = examples("observers")


@pytest.mark.parametrize("observer", BELIEFS, ids=named(BELIEFS))
def test_belief_laws(observer: StateObserver) -> None:
    check_observer(observer, seed=4)


ANGLE = fp.KalmanFilter(measured={"angle": 2e-3}, noise={"angle": 0.5}, start={"angle": 0.05, "angle'": 0.1})
TRACK = fp.ComputedTorque(fp.Exponential(rate=4.0))


def believed_swing() -> fp.Problem:
    """A pendulum whose angle is measured, with noise and a wrong mass."""
    plant, sensors = pendulum(1.0, 1.3), {"angle": fp.Sensor(noise=fp.Noise(2e-3))}
    plant = replace(plant, parameters={**plant.parameters, "l": fp.Parameter(0.6, 0.6, "m")})
    sensing = fp.Sensing(sensors, fp.PositionDifference(), measured=["angle"], observer=ANGLE)
    return swing(plant, start={"angle": 0.1, "angle'": 1.0}, period=0.01, sensing=sensing)


# Kalman's filter


def test_it_is_the_extended_filter_of_the_books():
    """Against an independent recursion in numpy on the nonlinear pendulum, with a wrong mass, to 1e-10."""
    problem = believed_swing()
    result = run(problem, TRACK)

    def rate(x, u, w):
        return np.array([x[1], (u - 0.1 * x[1]) / (1.3 * 0.6**2) - 9.81 / 0.6 * np.sin(x[0]) + w[0]])

    step, start = runge_kutta(rate, problem.period), (problem.start_state, np.array([0.05, 0.1]))
    states, expected = extended_filter(result, step, lambda x: x[:1], start, np.array([0.5]), 2e-3)
    np.testing.assert_allclose(result["state"], states, atol=1e-10)
    stepper = fp.Stepper(problem, TRACK, compiled=False)
    memory = stepper.start()
    for time, row in zip(result.time, samples(result), strict=True):
        _, memory = stepper.step_measured(float(time), row, memory)
    own = memory[stepper.memory.slice("observer_covariance")].reshape(2, 2)
    np.testing.assert_allclose(own, expected, rtol=1e-10)
    assert np.linalg.eigvalsh(own).min() > 0


def test_what_decays_need_not_be_observed():
    """Of propofol the plasma is measured; the effect site shows nowhere, and is believed by the model alone, as late as samples."""
    observer = fp.KalmanFilter(measured={"C1": 1e-2}, noise={"C1": 0.3, "C2": 0.05, "C3": 0.05})
    settings: dict[str, Any] = {
        "sensing": fp.Sensing({}, fp.VelocityDifference(), measured=["C1"], observer=observer),
        "dead_time": fp.DeadTime(inputs={"u": 1 / 6}, measurement=2 / 6),
        "duration": 15.0,
        "measure_from": 5.0,
    }
    result = run(replace(abroad.load("drug_infusion").problem, **settings), fp.ExactModel(TRACK))
    np.testing.assert_allclose(result["state"][3:], result["plant_state"][1:-2], atol=1e-11)


def test_a_state_that_cannot_be_observed_is_named_before_the_run():
    """From the speed of a mass nobody knows where it is."""
    observer = fp.KalmanFilter(measured={"y'": 0.1}, noise={"y": 1.0})
    sensing = fp.Sensing({}, fp.VelocityDifference(), measured=["y'"], observer=observer)
    with pytest.raises(NotSupported, match=r"KalmanFilter: y cannot be observed along the reference.*measure y"):
        run(replace(sine_of_three(), sensing=sensing), TRACK)


# Maps

T = 2.0  # s, one step of the map


def fishery(birth: float, noise: float) -> fp.Problem:
    """Ricker's stock in two ages: the adults are counted, the young are not."""
    plant = fp.Plant.discrete(
        states={"young": "1", "adult": "1"},
        inputs={"catch": "1"},
        parameters={"birth": fp.Parameter(approximate=birth, exact=2.5, unit="1")},
        next=lambda x, u, p: {
            "young": p.birth * x.adult * ca.exp(-x.adult),
            "adult": 0.5 * x.adult + 0.4 * x.young - u.catch,
        },
        outputs={"adult": fp.Output("1", lambda x, p: x.adult)},
        step=T,
    )
    filtered = fp.KalmanFilter({"adult": 0.02}, {"young": 0.02, "adult": 0.01}, start={"young": 0.1, "adult": 0.1})
    sensors = {"adult": fp.Sensor(noise=fp.Noise(noise))}
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"adult": 0.8 + 0.1 * ca.sin(0.15 * t)}),
        start={"young": 0.9, "adult": 0.7},
        period=T,
        duration=60.0,
        sensing=fp.Sensing(sensors, fp.Measured(), measured=["adult"], observer=filtered),
    )


def test_a_filter_of_a_map_is_that_of_the_books() -> None:
    """Against a recursion in numpy with a wrong birth rate; noise adds T w to the next state, as a disturbance does."""
    result = run(fishery(birth=3.0, noise=0.02), fp.ComputedTorque(fp.Exponential(rate=0.2)))

    def step(x: Any, u: float, w: Any) -> Any:
        young, adult = x
        return np.array([3.0 * adult * np.exp(-adult), 0.5 * adult + 0.4 * young - u]) + T * w

    start, noise = (np.array([0.9, 0.7]), np.array([0.1, 0.1])), np.array([0.02, 0.01])
    states, _ = extended_filter(result, step, lambda x: x[1:], start, noise, 0.02)
    np.testing.assert_allclose(result["state"], states, atol=1e-12)


# Outputs


PLAIN = fp.ComputedTorque(fp.Exponential(rate=1.0))
E0, STEEP = 93.0, 1.4
DEPTH = fp.KalmanFilter(
    measured={"depth": 0.3}, noise={"C": 0.05, "E": 0.05, "R": 0.02}, start={"C": 0.2, "E": 0.2, "R": 0.1}
)


def curve(level: Any, half: Any) -> Any:
    return E0 / (1 + (level / half) ** STEEP)


def sedated(believed: float = 4.0, noise: float = 0.0, **changes: Any) -> fp.Problem:
    """The depth from 74 to 50 and on to 40; it alone is measured.

    C' = u - C - (C - R) / 2, R' = (C - R) / 10, E' = (C - E) / 2, depth = E0 / (1 + (E / half)^g).
    """
    plant = fp.Plant.of_states(
        states={"C": "mg/l", "R": "mg/l", "E": "mg/l"},
        inputs={"u": "mg/l/min"},
        parameters={"half": fp.Parameter(approximate=believed, exact=4.0, unit="mg/l")},
        rates=lambda x, u, p: {"C": u.u - x.C - 0.5 * (x.C - x.R), "R": 0.1 * (x.C - x.R), "E": 0.5 * (x.C - x.E)},
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.E, p.half))},
        time_unit="min",
    )
    first, sensors = curve(1.5, 4.0), {"depth": fp.Sensor(noise=fp.Noise(noise))}

    def motion(t: Any) -> dict[str, Any]:
        return {"depth": 50 + (first - 50) * (1 + t / 2) * ca.exp(-t / 2) - 10 / (1 + ca.exp(10 - t))}

    settings: dict[str, Any] = {
        "sensing": fp.Sensing(sensors, fp.PositionDifference(), measured=["depth"], observer=DEPTH),
        "limits": fp.Limits(inputs={"u": (0.0, 40.0)}),
        "start": {"C": 1.5, "R": 1.5, "E": 1.5},
        "period": 1 / 12,
    }
    return fp.Problem(plant=plant, reference=fp.Trajectory(motion), **(settings | changes))


@pytest.mark.parametrize("late", [0.0, 2 / 12], ids=["at once", "two cycles late"])
def test_a_right_model_of_an_output_believes_what_is(late: float) -> None:
    """With exact parameters the states are the plant's, as late as the measurement is; the outputs are estimated."""
    problem = sedated(dead_time=fp.DeadTime(inputs={"u": 2 / 12}, measurement=late), duration=6.0)
    result, cycles = run(problem, PLAIN), round(late * 12)
    believed, true = result["state"], result["plant_state"]
    assert np.ptp(true, axis=0).min() > 0.5
    np.testing.assert_allclose(believed[cycles:], true[: len(true) - cycles], atol=1e-11)
    difference = np.diff(result["plant_output.depth"])[:5] * 12
    np.testing.assert_allclose(result["output.depth'"][1 + cycles : 6 + cycles], difference, atol=1e-9)


def test_a_model_referenced_form_passes_the_null_test_on_believed_states() -> None:
    """With an exact model it changes nothing: the twin's response passes the same estimator."""
    referenced = PLAIN.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.5)))
    first, second = (run(sedated(duration=6.0), c) for c in (PLAIN, referenced))
    np.testing.assert_allclose(first["state"], second["state"], atol=1e-9)


def test_a_filter_of_an_output_is_that_of_the_books() -> None:
    """Against a recursion in numpy with a wrong curve: rates by hand, Jacobians by the complex step, to 1e-10."""
    result = run(sedated(believed=5.0, noise=0.3, duration=8.0), PLAIN)

    def rate(x: Any, u: float, w: Any) -> Any:
        c, r, e = x
        return np.array([u - c - 0.5 * (c - r), 0.1 * (c - r), 0.5 * (c - e)]) + w

    start, noise = (np.full(3, 1.5), np.array([0.2, 0.1, 0.2])), np.array([0.05, 0.02, 0.05])  # C, R, E
    states, _ = extended_filter(result, runge_kutta(rate, 1 / 12), lambda x: curve(x[2:], 5.0), start, noise, 0.3)
    np.testing.assert_allclose(result["state"], states, atol=1e-10)
    assert np.abs(result["state"] - result["plant_state"]).max() > 0.3
