"""A linear plant along a sine, its realities - behind a lag, behind a slow sensor, outside - and controllers of it."""

from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from helpers.plants import linear

TRACK = fp.Exponential(rate=6.0)
PERIOD = 1e-3  # s
TAU = 0.01  # s, lag of the actuator
FPI = fp.Sigmoid(gain=-0.5, scale=50.0)

CONTROLLERS = {
    "computed torque": fp.ComputedTorque(TRACK),
    "plain form": fp.ComputedTorque(TRACK, FPI),
    "model-referenced form": fp.ComputedTorque(TRACK, fp.ModelReferenced(FPI)),
    "receding horizon": fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-3), FPI),
}
SENSING: dict[str, dict[str, Any]] = {
    "ideal": {},
    "estimated": {"sensing": fp.Sensing(estimator=fp.PositionDifference())},
    "noisy": {"sensing": fp.Sensing(sensors={"y'": fp.Sensor(noise=fp.Noise(1e-4), dropout=0.1)})},
    "late": {
        "dead_time": fp.DeadTime(measurement=2.5 * PERIOD),
        "disturbances": {"y": fp.Formula(lambda t: 0.1 * ca.sin(2 * np.pi * 2.0 * t))},
    },
}

# The twin meets every way of sensing, every controller noisy sensors.
PAIRS = [("model-referenced form", s) for s in SENSING] + [(c, "noisy") for c in CONTROLLERS if "referenced" not in c]


def parameters(gain: float = 2.0) -> dict[str, fp.Parameter]:
    """The gain of the linear plant; the model believes in 1."""
    return {"b": fp.Parameter(approximate=1.0, exact=gain, unit="1/kg")}


def lagged(tau: float = TAU, gain: float = 2.0) -> fp.Plant:
    """Y'' = b F behind an actuator, tau F' = u - F."""
    return fp.Plant(
        coordinates={"y": "m", "F": "N"},
        inputs={"u": "N"},
        order={"y": 2, "F": 1},
        parameters=parameters(gain) | {"tau": fp.Parameter(approximate=tau, exact=tau, unit="s")},
        response=lambda q, v, u, p: {"y": p.b * q.F, "F": (u.u - q.F) / p.tau},
    )


def slow_sensor(tau: float = TAU) -> fp.Plant:
    """Y'' = b u, measured through tau s' = y - s."""
    return fp.Plant(
        coordinates={"y": "m", "s": "m"},
        inputs={"u": "N"},
        order={"y": 2, "s": 1},
        parameters=parameters(),
        response=lambda q, v, u, p: {"y": p.b * u.u, "s": (q.y - q.s) / tau},
    )


def task(**changes) -> fp.Problem:
    """The linear plant along a sine."""
    settings: dict[str, Any] = {
        "plant": linear(2.0, 1.0),
        "reference": fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}),
        "start": {"y": 0.1},
        "period": PERIOD,
        "duration": 0.3,
        "limits": fp.Limits(inputs={"u": (-50.0, 50.0)}),
        "horizon": fp.Horizon(stages=5, step=1e-2),
        "cost": fp.Quadratic(states={"y": 1e3, "y'": 1.0}, effort={"u": 1e-3}),
    }
    return fp.Problem(**{**settings, **changes})


def run(problem: fp.Problem, controller: Any = CONTROLLERS["computed torque"]) -> fp.Run:
    """A run in the virtual machine."""
    return fp.simulate(problem, controller, seed=0, compiled=False)


MEASURES = {"y": "m", "y'": "m/s", "y''": "m/s^2"}


class Wrapped:
    """The problem's own plant behind reset and step, moved by a Runge-Kutta step of numpy's own."""

    calls = 0

    def __init__(self, problem: fp.Problem, measures=tuple(MEASURES)) -> None:
        self.problem, self.measures = problem, measures

    def reset(self, seed):
        del seed
        self.calls = 0
        self.x = np.array(self.problem.start_state)
        return self._answer(np.array(self.problem.inputs_before))

    def step(self, time, command):
        self.calls, h = self.calls + 1, self.problem.period
        assert time == pytest.approx((self.calls - 1) * h)
        k1 = self._rate(self.x, command)
        k2 = self._rate(self.x + h / 2 * k1, command)
        k3 = self._rate(self.x + h / 2 * k2, command)
        k4 = self._rate(self.x + h * k3, command)
        self.x = self.x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return self._answer(command)

    def _rate(self, x, u):
        return np.array([x[1], 2.0 * u[0]])

    def _answer(self, u):
        every = {"y": self.x[0], "y'": self.x[1], "y''": self._rate(self.x, u)[1]}
        return np.array([every[name] for name in self.measures])
