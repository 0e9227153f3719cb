"""Observers of other kinds of plants - maps, outputs that the command moves at once - and their live settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.filters import extended_filter
from helpers.plants import linear

import fpirhc as fp
from fpirhc.conformance import check_live
from fpirhc.contracts import StateObserver
from fpirhc.errors import NotSupported

TRACK = fp.ComputedTorque(fp.Exponential(rate=0.2))
T = 2.0  # s, one step of the map
NOISES: dict[str, Any] = {
    "measured": {"adult": 0.02},
    "noise": {"young": 0.02, "adult": 0.01},
    "start": {"young": 0.1, "adult": 0.1},
}
FILTER = fp.KalmanFilter(**NOISES)


def run(problem: fp.Problem, controller: Any = TRACK, seed: int = 0) -> fp.Run:
    return fp.simulate(problem, controller, seed=seed, compiled=False)


# Maps


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


@pytest.mark.parametrize("observer", [FILTER], ids=lambda b: type(b).__name__)
def test_the_right_map_believes_what_is(observer: StateObserver) -> None:
    result = run(fishery(observer))
    np.testing.assert_allclose(result["state"], result["plant_state"], atol=1e-12)
    assert np.ptp(result["plant_state"], axis=0).min() > 0.02


def test_a_filter_of_a_map_is_that_of_the_books() -> None:
    """Against a recursion in numpy with a wrong birth rate; noise adds T w to the next state, as a disturbance does."""
    result = run(fishery(FILTER, birth=3.0, noise=0.02))

    def step(x: Any, u: float, w: Any) -> Any:
        young, adult = x
        return np.array([3.0 * adult * np.exp(-adult), 0.5 * adult + 0.4 * young - u]) + T * w

    start, noise = (np.array([0.9, 0.7]), np.array([0.1, 0.1])), np.array([0.02, 0.01])
    states, _ = extended_filter(result, step, lambda x: x[1:], start, noise, 0.02)
    np.testing.assert_allclose(result["state"], states, atol=1e-12)


# Outputs that the command moves at once


# Signals from outside


def room(observer: StateObserver) -> fp.Problem:
    """A heated room in known weather: what is felt is measured, air and walls are believed."""
    plant = fp.Plant.of_states(
        states={"air": "K", "walls": "K"},
        inputs={"heat": "kW"},
        parameters={"loss": fp.Parameter(0.3, 0.3, "kW/K"), "ambient": fp.outside(nominal=280.0, unit="K")},
        rates=lambda x, u, p: {
            "air": p.loss * (p.ambient - x.air) + 0.5 * (x.walls - x.air) + u.heat,
            "walls": 0.1 * (x.air - x.walls) + 0.05 * (p.ambient - x.walls),
        },
        outputs={"felt": fp.Output("K", lambda x, p: 0.7 * x.air + 0.3 * x.walls)},
        time_unit="h",
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"felt": 291.0 + ca.sin(0.3 * t)}),
        start={"air": 292.0, "walls": 289.0},
        period=0.25,
        duration=10.0,
        signals={"ambient": fp.Known(lambda t: 280.0 + 5.0 * ca.sin(0.4 * t))},
        sensing=fp.Sensing({}, fp.PositionDifference(), measured=["felt"], observer=observer),
    )


ROOM: dict[str, Any] = {"measured": {"felt": 0.1}, "noise": {"air": 0.1, "walls": 0.1}}


@pytest.mark.parametrize(
    ("observer", "late"),
    [(fp.KalmanFilter(**ROOM), 2)],
    ids=lambda v: type(v).__name__ if isinstance(v, StateObserver) else str(v),
)
def test_a_right_model_in_known_weather_believes_what_is(observer: StateObserver, late: float) -> None:
    """The model moves in the weather of the time of the samples, in every cycle of a window too, interpolated as they are."""
    problem = replace(room(observer), dead_time=fp.DeadTime(measurement=0.25 * late))
    result, whole, part = run(problem, fp.ComputedTorque(fp.Exponential(rate=0.5))), int(late), late % 1
    true = result["plant_state"]
    count = len(true) - whole - 1
    assert np.ptp(true[:, 1]) > 0.5
    expected = (1 - part) * true[1 : count + 1] + part * true[:count]
    np.testing.assert_allclose(result["state"][whole + 1 :], expected, atol=1e-9)


# Live settings


def double(observer: StateObserver, **changes: Any) -> fp.Problem:
    sensing = fp.Sensing(
        {"y": fp.Sensor(noise=fp.Noise(1e-3), quantum=1e-4)}, fp.PositionDifference(), measured=["y"], observer=observer
    )
    settings: dict[str, Any] = {"sensing": sensing, "period": 0.01, "duration": 0.2, "start": {"y": 0.0}}
    reference = fp.Trajectory(lambda t: {"y": 0.3 * ca.sin(t)})
    return fp.Problem(plant=linear(1.0, 1.0), reference=reference, **(settings | changes))


HALF: dict[str, Any] = {"measured": {"y": 1e-3}, "noise": {"y": 0.5}, "start": {"y": 1.0}}


def test_noises_of_a_filter_are_live_bit_by_bit() -> None:
    paths = [
        "sensing.observer.measured.y",
        "sensing.observer.noise.y",
        "sensing.sensors.y.quantum",
        "sensing.observer.start.y",
    ]
    problem = double(fp.KalmanFilter(**HALF))
    live = {one.path: one.refused for one in check_live(problem, TRACK, paths=paths, cycles=12)}
    assert [path for path in paths if not live[path]] == paths[:3]


def test_a_late_measurement_is_not_live_beside_a_observer() -> None:
    late = fp.DeadTime(inputs={"u": 0.02}, measurement=0.01, longest={"u": 0.04, "measurement": 0.02})
    problem = double(fp.KalmanFilter(**HALF), dead_time=late)
    with pytest.raises(NotSupported, match=r"'dead_time.measurement' cannot be live here"):
        fp.simulator(problem, TRACK, compiled=False, live=["dead_time.measurement"])
    [tried] = check_live(problem, TRACK, paths=["dead_time.inputs.u"], cycles=12)
    assert not tried.refused
