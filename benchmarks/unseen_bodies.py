"""Five bodies that no rule of the probe was made on: a cart with a load that swings, a ship's heading, an oven, a fan, a tank.

Each is a body outside behind a simple, wrong model, with an actuator of its own. `benchmarks/probing.py` runs them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

import fpirhc as fp

FINER = 20  # steps of a body in a cycle
OPTIMISER = fp.FixedPoint(iterations=1, tolerance=1e-2)


@dataclass
class Cart:
    """A cart of 2.4 kg with 0.8 kg on a rope of .5 m, dry friction of 1.5 N, and a motor that lags by 25 ms.

    The model is a cart of 2 kg. Measured are place, speed, and acceleration with a noise of .05 m/s^2.
    """

    period: float = 1e-2

    def reset(self, seed: int) -> np.ndarray:
        """Begin at rest."""
        self.random, self.force = np.random.default_rng(seed), 0.0
        self.x = self.v = self.angle = self.rate = 0.0
        return np.zeros(3)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a cycle."""
        del time
        h, mass, load, rope = self.period / FINER, 2.4, 0.8, 0.5
        for _ in range(FINER):
            self.force += h / 0.025 * (float(command[0]) - self.force)
            sine, cosine = math.sin(self.angle), math.cos(self.angle)
            pushed = self.force - 1.5 * math.tanh(self.v / 5e-3) - 2.0 * self.v
            # A load on a rope: (M + m s^2) x'' = F + m s (l w^2 + g c), l w' = -x'' c - g s.
            a = (pushed + load * sine * (rope * self.rate**2 + 9.81 * cosine)) / (mass + load * sine**2)
            turned = -(a * cosine + 9.81 * sine) / rope - 0.1 * self.rate
            self.v, self.rate = self.v + h * a, self.rate + h * turned
            self.x, self.angle = self.x + h * self.v, self.angle + h * self.rate
        return np.array([self.x, self.v, a + 0.05 * self.random.standard_normal()])


@dataclass
class Ship:
    """Norrbin's equation T r' + r + .4 T^2 r^3 = K (rudder + wind), with a rudder that turns by 3 deg/s at most, to 35 deg.

    T = 31 s and K = .11 1/s; the model has T = 20 s, K = .08 1/s. Measured are heading, and rate and its change with noise.
    """

    period: float = 0.5

    def reset(self, seed: int) -> np.ndarray:
        """Begin straight on."""
        self.random = np.random.default_rng(seed)
        self.heading = self.rate = self.rudder = 0.0
        return np.zeros(3)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a cycle."""
        h, fastest, most = self.period / FINER, math.radians(3), math.radians(35)
        for _ in range(FINER):
            asked = min(max(float(command[0]), -most), most)
            self.rudder += min(max((asked - self.rudder) / 0.8, -fastest), fastest) * h
            wind = math.radians(4) * math.sin(0.05 * time)
            change = (0.11 * (self.rudder + wind) - self.rate - 0.4 * 31**2 * self.rate**3) / 31
            self.rate += h * change
            self.heading += h * self.rate
        noise = self.random.standard_normal(2) * (1e-5, 2e-5)
        return np.array([self.heading, self.rate + noise[0], change + noise[1]])


@dataclass
class Oven:
    """Air in an oven: the heat comes 24 s late and heats a wall of 15 s first; losses to 20 degC, and by radiation.

    The model is one balance, 150 s and 1.6 K/%, in which heat comes at once. The sensor has a noise of .03 K.
    """

    period: float = 4.0

    def reset(self, seed: int) -> np.ndarray:
        """Begin at the temperature of the room."""
        self.random, self.late = np.random.default_rng(seed), [0.0] * 6
        self.air, self.wall = 20.0, 0.0
        return np.array([self.air])

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a cycle."""
        del time
        self.late.append(float(command[0]))
        heat, h = self.late.pop(0), self.period / FINER
        for _ in range(FINER):
            self.wall += h / 15.0 * (heat - self.wall)
            lost = self.air - 20.0 + 2e-9 * ((self.air + 273) ** 4 - 293**4)
            self.air += h / 190.0 * (2.6 * self.wall - lost)
        return np.array([self.air + 0.03 * self.random.standard_normal()])


@dataclass
class Fan:
    """A fan at the end of a beam: thrust of its speed squared, a motor of 120 ms, a counterweight, a gust that comes and goes.

    The model is a beam of .06 kg m^2 that the thrust turns. Measured are angle, rate and, with a noise of .2 rad/s^2, its change.
    """

    period: float = 2e-2

    def reset(self, seed: int) -> np.ndarray:
        """Begin level and at rest, at the speed that carries the beam."""
        self.random, self.angle, self.rate = np.random.default_rng(seed), 0.0, 0.0
        self.speed = math.sqrt(1.2)  # of thrust 1 N
        return np.zeros(3)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a cycle."""
        h, gust = self.period / FINER, 0.15 * math.sin(0.9 * time) * math.cos(0.37 * time)
        for _ in range(FINER):
            self.speed += h / 0.12 * (math.sqrt(max(float(command[0]), 0.0)) - self.speed)
            moment = 0.4 * (self.speed**2 + gust) - 0.48 * math.cos(self.angle) - 0.25 * math.sin(self.angle)
            change = (moment - 0.05 * self.rate - 0.02 * math.tanh(self.rate / 0.01)) / 0.085
            self.rate += h * change
            self.angle += h * self.rate
        return np.array([self.angle, self.rate, change + 0.2 * self.random.standard_normal()])


@dataclass
class Tank:
    """Water in a cone over a pipe of 3 s and a pump of 4 s, which somebody else drains too. The model is a cylinder.

    The level is measured with a noise of .3 mm in steps of .1 mm.
    """

    period: float = 1.0

    def reset(self, seed: int) -> np.ndarray:
        """Begin at .4 m."""
        self.random, self.level, self.pumped, self.late = np.random.default_rng(seed), 0.4, 0.5, [0.5] * 3
        return np.array([self.level])

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a cycle."""
        self.late.append(min(max(float(command[0]), 0.0), 2.0))
        asked, h, drained = self.late.pop(0), self.period / FINER, 0.1 if 150 < time < 260 else 0.0
        for _ in range(FINER):
            self.pumped += h / 4.0 * (asked - self.pumped)
            area = math.pi * (0.08 + 0.15 * self.level) ** 2
            self.level += h * 1e-3 * (self.pumped - 0.7 * math.sqrt(max(self.level, 0.0)) - drained) / area
        return np.array([1e-4 * round(1e4 * (self.level + 3e-4 * self.random.standard_normal()))])


def known(value: float, unit: str) -> fp.Parameter:
    """Return a parameter of a model whose plant is outside."""
    return fp.Parameter(value, value, unit)


def of_second_order(name: str, unit: str) -> dict[str, str]:
    """Return what is measured of a coordinate."""
    return {name: unit, f"{name}'": f"{unit}/s", f"{name}''": f"{unit}/s^2"}


def cart() -> fp.Problem:
    """Return the task to move to and fro by .6 m in 4 s."""
    plant = fp.Plant({"x": "m"}, {"F": "N"}, {"M": known(2.0, "kg")}, lambda q, v, u, p: {"x": u.F / p.M})
    return fp.Problem(
        plant=plant,
        reality=fp.ExternalPlant(Cart(), measures=of_second_order("x", "m")),
        reference=fp.Trajectory(lambda t: {"x": 0.3 * (1 - ca.cos(2 * math.pi / 4 * t))}),
        start={"x": 0.0},
        period=1e-2,
        duration=8.0,
        measure_from=1.0,
        limits=fp.Limits(inputs={"F": (-40.0, 40.0)}),
        horizon=fp.Horizon(stages=20, step=5e-2),
        cost=fp.Quadratic(states={"x": 100.0, "x'": 5.0}, deviation={"F": 0.2}),
    )


def ship() -> fp.Problem:
    """Return the task to turn by 20 degrees to both sides within two minutes."""
    plant = fp.Plant(
        {"psi": "rad"},
        {"rudder": "rad"},
        {"K": known(0.08, "1/s"), "T": known(20.0, "s")},
        lambda q, v, u, p: {"psi": (p.K * u.rudder - v.psi) / p.T},
    )
    return fp.Problem(
        plant=plant,
        reality=fp.ExternalPlant(Ship(), measures=of_second_order("psi", "rad")),
        reference=fp.Trajectory(lambda t: {"psi": math.radians(20) * (1 - ca.cos(2 * math.pi / 120 * t)) / 2}),
        start={"psi": 0.0},
        period=0.5,
        duration=360.0,
        measure_from=60.0,
        limits=fp.Limits(inputs={"rudder": (-math.radians(35), math.radians(35))}),
        horizon=fp.Horizon(stages=20, step=2.0),
        cost=fp.Quadratic(states={"psi": 100.0, "psi'": 500.0}, deviation={"rudder": 1.0}),
    )


def oven() -> fp.Problem:
    """Return the task to heat to 80 degC and to swing about it."""
    plant = fp.Plant(
        {"T": "degC"},
        {"Q": "%"},
        {"K": known(1.6, "K/%"), "tau": known(150.0, "s")},
        lambda q, u, p: {"T": (p.K * u.Q - (q.T - 20)) / p.tau},
        order=1,
    )
    return fp.Problem(
        plant=plant,
        reality=fp.ExternalPlant(Oven(), measures={"T": "degC"}),
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        reference=fp.Trajectory(lambda t: {"T": 20 + 60 * (1 - ca.exp(-t / 150)) + 5 * ca.sin(2 * math.pi / 600 * t)}),
        start={"T": 20.0},
        period=4.0,
        duration=2400.0,
        measure_from=300.0,
        limits=fp.Limits(inputs={"Q": (0.0, 100.0)}),
        horizon=fp.Horizon(stages=20, step=16.0),
        cost=fp.Quadratic(states={"T": 1.0}, deviation={"Q": 1e-3}),
    )


def fan() -> fp.Problem:
    """Return the task to raise and to lower the beam by .3 rad in 5 s."""
    plant = fp.Plant(
        {"pitch": "rad"},
        {"thrust": "N"},
        {"J": known(0.06, "kg m^2"), "L": known(0.4, "m"), "weight": known(1.0, "N")},
        lambda q, v, u, p: {"pitch": p.L * (u.thrust - p.weight) / p.J},
    )
    return fp.Problem(
        plant=plant,
        reality=fp.ExternalPlant(Fan(), measures=of_second_order("pitch", "rad")),
        reference=fp.Trajectory(lambda t: {"pitch": 0.3 * ca.sin(2 * math.pi / 5 * t) ** 2}),
        start={"pitch": 0.0},
        period=2e-2,
        duration=15.0,
        measure_from=2.5,
        limits=fp.Limits(inputs={"thrust": (0.0, 4.0)}),
        horizon=fp.Horizon(stages=20, step=8e-2),
        cost=fp.Quadratic(states={"pitch": 100.0, "pitch'": 5.0}, deviation={"thrust": 1.0}),
    )


def tank() -> fp.Problem:
    """Return the task to swing about .5 m."""
    plant = fp.Plant(
        {"level": "m"},
        {"flow": "l/s"},
        {"A": known(0.07, "m^2"), "c": known(0.7, "l/s")},
        lambda q, u, p: {"level": 1e-3 * (u.flow - p.c * ca.sqrt(ca.fmax(q.level, 1e-3))) / p.A},
        order=1,
    )
    return fp.Problem(
        plant=plant,
        reality=fp.ExternalPlant(Tank(), measures={"level": "m"}),
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        reference=fp.Trajectory(lambda t: {"level": 0.4 + 0.1 * (1 - ca.cos(2 * math.pi / 120 * t))}),
        start={"level": 0.4},
        period=1.0,
        duration=500.0,
        measure_from=60.0,
        limits=fp.Limits(inputs={"flow": (0.0, 2.0)}),
        horizon=fp.Horizon(stages=20, step=4.0),
        cost=fp.Quadratic(states={"level": 1e4}, deviation={"flow": 1.0}),
    )


BODIES: dict[str, Callable[[], fp.Problem]] = {"cart": cart, "ship": ship, "oven": oven, "fan": fan, "tank": tank}
CONTROLLER = fp.RecedingHorizon(OPTIMISER)
