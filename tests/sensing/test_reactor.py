"""The batch reactor 2A -> B of Haseltine and Rawlings, Ind. Eng. Chem. Res. 44(8), 2005, which starts at a wrong guess."""

from typing import Any

import casadi as ca
import pytest

import fpirhc as fp
from fpirhc.contracts import Controller, StateObserver

TRACK = fp.ComputedTorque(fp.Exponential(rate=4.0))


def sensed(name: str, deviation: float, observer: StateObserver) -> fp.Sensing:
    sensors = {name: fp.Sensor(noise=fp.Noise(deviation))}
    return fp.Sensing(sensors, fp.PositionDifference(), measured=[name], observer=observer)


def run(problem: fp.Problem, controller: Controller = TRACK, seed: int = 0, compiled: bool = False) -> fp.Run:
    return fp.simulate(problem, controller, seed=seed, compiled=compiled)


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
