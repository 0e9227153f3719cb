"""Believed states: what no sensor shows, by the model and by Kalman's filter of the books; what cannot be known is named."""

from dataclasses import replace
from typing import Any

import abroad
import casadi as ca
import numpy as np
import pytest
from helpers.filters import extended_filter, runge_kutta
from helpers.plants import pendulum
from helpers.plants import simulated as run
from helpers.replay import samples

import fpirhc as fp
from fpirhc.conformance import check_observer, examples
from fpirhc.contracts import StateObserver
from fpirhc.errors import NotSupported

CTC = fp.ComputedTorque(fp.Exponential(rate=0.5))
FPI = fp.ComputedTorque(fp.Exponential(rate=0.5), fp.Affine(gain=-0.5))
KALMAN = fp.KalmanFilter(measured={"C1": 1e-2}, noise={"C1": 0.3, "C2": 0.05, "C3": 0.05})
BELIEFS = examples("observers")


@pytest.mark.parametrize("number", range(len(BELIEFS)), ids=[f"{type(b).__name__}-{k}" for k, b in enumerate(BELIEFS)])
def test_belief_laws(number: int) -> None:
    check_observer(BELIEFS[number], seed=4)


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


def covariance(stepper: fp.Stepper, result: fp.Run, size: int) -> np.ndarray:
    """That of the filter after a run."""
    memory, rows = stepper.start(), samples(result)
    for time, row in zip(result.time, rows, strict=True):
        _, memory = stepper.step_measured(float(time), row, memory)
    return memory[stepper.memory.slice("observer_covariance")].reshape(size, size)


# The model alone


def test_behind_dead_time_states_are_those_of_the_samples():
    """Commands one and samples two cycles late: every believed state is the one of that time, to rounding."""
    dead_time = fp.DeadTime(inputs={"u": 1 / 6}, measurement=2 / 6)
    problem = infusion(KALMAN, dead_time=dead_time, input_before={"u": 9.0}, duration=15.0)
    result = run(problem, fp.ExactModel(CTC))
    true = result["plant_state"]
    expected = true[1:-2]
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
    states, expected = extended_filter(result, step, lambda x: x[:1], start, np.array([0.5]), 2e-3)
    np.testing.assert_allclose(result["state"], states, atol=1e-10)
    own = covariance(fp.Stepper(problem, TRACK, compiled=False), result, 2)
    np.testing.assert_allclose(own, expected, rtol=1e-10)
    assert np.linalg.eigvalsh(own).min() > 0


def test_a_model_referenced_form_passes_the_null_test_on_believed_states():
    """With an exact model it changes nothing: the twin's response passes the same estimator."""
    problem = infusion(KALMAN, duration=10.0)
    referenced = fp.ComputedTorque(fp.Exponential(rate=0.5), fp.ModelReferenced(fp.Affine(gain=-0.5)))
    first, second = (run(problem, fp.ExactModel(c)) for c in (CTC, referenced))
    np.testing.assert_allclose(first["state"], second["state"], atol=1e-9)


def test_a_state_that_cannot_be_observed_is_named_before_the_run():
    """From the load's speed nobody knows the angles: a turn of the whole servo shows nowhere and stays."""
    observer = fp.KalmanFilter(measured={"load'": 0.1}, noise={"motor": 1.0})
    problem = servo(observer, sensing=fp.Sensing({}, fp.PositionDifference(), measured=["load'"], observer=observer))
    with pytest.raises(
        NotSupported,
        match=r"KalmanFilter: load and motor cannot be observed along the reference from load'.*measure load",
    ):
        run(problem, CTC)


# Maps, and signals from outside


T = 2.0  # s, one step of the map
NOISES: dict[str, Any] = {
    "measured": {"adult": 0.02},
    "noise": {"young": 0.02, "adult": 0.01},
    "start": {"young": 0.1, "adult": 0.1},
}
FILTER = fp.KalmanFilter(**NOISES)


SLOWLY = fp.ComputedTorque(fp.Exponential(rate=0.2))


def fishery(observer: StateObserver, birth: float = 2.5, noise: float = 0.0, **changes: Any) -> fp.Problem:
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
    sensors = {"adult": fp.Sensor(noise=fp.Noise(noise))} if noise else {}
    settings: dict[str, Any] = {"sensing": fp.Sensing(sensors, fp.Measured(), measured=["adult"], observer=observer)}
    return fp.Problem(
        plant=plant, reference=fp.Trajectory(lambda t: {"adult": 0.8 + 0.1 * ca.sin(0.15 * t)}),
        start={"young": 0.9, "adult": 0.7}, period=T, duration=60.0, **(settings | changes),
    )  # fmt: skip


def test_a_filter_of_a_map_is_that_of_the_books() -> None:
    """Against a recursion in numpy with a wrong birth rate; noise adds T w to the next state, as a disturbance does."""
    result = run(fishery(FILTER, birth=3.0, noise=0.02), SLOWLY)

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


def drug(believed: float = 4.0) -> fp.Plant:
    """C' = u - C - (C - R) / 2, R' = (C - R) / 10, E' = (C - E) / 2, depth = E0 / (1 + (E / half)^g)."""
    return fp.Plant.of_states(
        states={"C": "mg/l", "R": "mg/l", "E": "mg/l"},
        inputs={"u": "mg/l/min"},
        parameters={"half": fp.Parameter(approximate=believed, exact=4.0, unit="mg/l")},
        rates=lambda x, u, p: {"C": u.u - x.C - 0.5 * (x.C - x.R), "R": 0.1 * (x.C - x.R), "E": 0.5 * (x.C - x.E)},
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.E, p.half))},
        time_unit="min",
    )


def sedated(observer: StateObserver | None, believed: float = 4.0, **changes: Any) -> fp.Problem:
    """The depth from 74 to 50 and on to 40; it alone is measured."""
    plant, first = drug(believed), curve(1.5, 4.0)

    def motion(t: Any) -> dict[str, Any]:
        return {"depth": 50 + (first - 50) * (1 + t / 2) * ca.exp(-t / 2) - 10 / (1 + ca.exp(10 - t))}

    settings: dict[str, Any] = {
        "sensing": fp.Sensing({}, fp.PositionDifference(), measured=["depth"], observer=observer),
        "limits": fp.Limits(inputs={"u": (0.0, 40.0)}),
        "start": {"C": 1.5, "R": 1.5, "E": 1.5},
        "period": 1 / 12,
        "duration": 20.0,
        "measure_from": 3.0,
    }
    return fp.Problem(plant=plant, reference=fp.Trajectory(motion), **(settings | changes))


@pytest.mark.parametrize("late", [0.0, 2 / 12], ids=["at once", "two cycles late"])
def test_a_right_model_of_an_output_believes_what_is(late: float) -> None:
    """With exact parameters the states are the plant's, as late as the measurement is; the outputs are estimated."""
    problem = sedated(DEPTH, dead_time=fp.DeadTime(inputs={"u": 2 / 12}, measurement=late), duration=6.0)
    result, cycles = run(problem, PLAIN), round(late * 12)
    believed, true = result["state"], result["plant_state"]
    assert np.ptp(true, axis=0).min() > 0.5
    np.testing.assert_allclose(believed[cycles:], true[: len(true) - cycles], atol=1e-11)
    difference = np.diff(result["plant_output.depth"])[:5] * 12
    np.testing.assert_allclose(result["output.depth'"][1 + cycles : 6 + cycles], difference, atol=1e-9)


def test_a_filter_of_an_output_is_that_of_the_books() -> None:
    """Against a recursion in numpy with a wrong curve: rates by hand, Jacobians by the complex step, to 1e-10."""
    sensors = {"depth": fp.Sensor(noise=fp.Noise(0.3))}
    sensing = fp.Sensing(sensors, fp.PositionDifference(), measured=["depth"], observer=DEPTH)
    problem = sedated(DEPTH, believed=5.0, sensing=sensing, duration=8.0)
    result = run(problem, PLAIN)

    def rate(x: Any, u: float, w: Any) -> Any:
        c, r, e = x
        return np.array([u - c - 0.5 * (c - r), 0.1 * (c - r), 0.5 * (c - e)]) + w

    start, noise = (np.full(3, 1.5), np.array([0.2, 0.1, 0.2])), np.array([0.05, 0.02, 0.05])  # C, R, E
    states, _ = extended_filter(result, runge_kutta(rate, 1 / 12), lambda x: curve(x[2:], 5.0), start, noise, 0.3)
    np.testing.assert_allclose(result["state"], states, atol=1e-10)
    assert np.abs(result["state"] - result["plant_state"]).max() > 0.3
