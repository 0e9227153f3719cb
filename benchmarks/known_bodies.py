"""Three bodies with known gains, dead times and lags, written after the rule of the probe and before it saw them: a blind test.

The response is Lambda g + friction and the like, with g_j the command j, late by some cycles and behind a lag of first order; the
model is response = command, at once. `benchmarks/probing.py` runs them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

import fpirhc as fp

FINER = 10  # steps of a body in a cycle
Push = Callable[[float, np.ndarray, np.ndarray], np.ndarray]  # (time, q, v) -> what the model does not have


@dataclass
class Known:
    """A body whose answers are known.

    Args:
        order: of its motion, 1 or 2.
        gains: Lambda.
        dead: time of every input, cycles.
        lag: of every input, s.
        noise: of the measured response, standard deviation.
        push: what the model does not have.
        period: s.
    """

    order: int
    gains: np.ndarray
    dead: tuple[int, ...]
    lag: tuple[float, ...]
    noise: float
    push: Push
    period: float = 1e-2

    def reset(self, seed: int) -> np.ndarray:
        """Begin at rest at zero."""
        n = len(self.gains)
        self.random, self.queues = np.random.default_rng(seed), [[0.0] * d for d in self.dead]
        self.q, self.v, self.acting = np.zeros((3, n))
        return np.zeros((self.order + 1) * n)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a cycle."""
        for queue, value in zip(self.queues, command, strict=True):
            queue.append(float(value))
        late, h = np.array([queue.pop(0) for queue in self.queues]), self.period / FINER
        kept = np.array([math.exp(-h / lag) if lag else 0.0 for lag in self.lag])
        for k in range(FINER):
            self.acting = late + (self.acting - late) * kept
            rate = self.gains @ self.acting + self.push(time + k * h, self.q, self.v)
            if self.order == 1:
                self.q = self.q + h * rate
            else:
                self.q, self.v = self.q + h * self.v + h * h / 2 * rate, self.v + h * rate
        seen = (self.q, self.v)[: self.order]
        return np.concatenate([*seen, rate + self.noise * self.random.standard_normal(len(rate))])


def task(
    body: Known, names: tuple[str, ...], turns: tuple[float, ...], limit: float, costs: tuple[float, ...]
) -> fp.Problem:
    """Return the task to follow 1 - cos(2 pi turn t), turns in 1/s, with the model response = command.

    Args:
        body: the reality.
        names: of its coordinates.
        turns: one for each.
        limit: of the commands.
        costs: of a coordinate and of its derivatives; a command's deviation costs 1.
    """
    inputs, dashes = {f"to_{name}": "1" for name in names}, ("", "'", "''")[: body.order + 1]
    units = ("m", "m/s", "m/s^2")

    def response(*views: object) -> dict[str, ca.SX]:
        u, p = views[-2:]
        return {name: p.b * u[f"to_{name}"] for name in names}  # type: ignore[attr-defined,index]

    plant = fp.Plant(
        coordinates=dict.fromkeys(names, "m"),
        inputs=dict.fromkeys(inputs, units[body.order]),
        parameters={"b": fp.Parameter(1.0, 1.0, "1")},
        response=(lambda q, u, p: response(u, p)) if body.order == 1 else (lambda q, v, u, p: response(u, p)),
        order=body.order,
    )
    return fp.Problem(
        plant=plant,
        reality=fp.ExternalPlant(body, measures={n + d: units[k] for k, d in enumerate(dashes) for n in names}),
        reference=fp.Trajectory(
            lambda t: {n: 1 - ca.cos(2 * math.pi * turn * t) for n, turn in zip(names, turns, strict=True)}
        ),
        start=dict.fromkeys(names, 0.0),
        period=body.period,
        duration=800 * body.period,
        measure_from=100 * body.period,
        limits=fp.Limits(inputs=dict.fromkeys(inputs, (-limit, limit))),
        horizon=fp.Horizon(stages=20, step=5 * body.period),
        cost=fp.Quadratic(
            states={n + d: cost for d, cost in zip(dashes, costs, strict=False) for n in names},
            deviation=dict.fromkeys(inputs, 1.0),
        ),
    )


def turned(angle: float) -> np.ndarray:
    """Return the matrix that turns a plane."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


# A table in a plane whose motors stand 25 degrees askew and act two and one cycles late; dry friction.
STAGE = Known(
    2, 1.3 * turned(math.radians(25)), (2, 1), (0.02, 0.02), 0.1, lambda t, q, v: -0.8 * np.tanh(v / 0.02) - 0.4 * v
)
# An inverted pendulum whose motor is half as strong as believed and acts three cycles late; unstable.
PENDULUM = Known(2, np.array([[0.55]]), (3,), (0.015,), 0.05, lambda t, q, v: 3 * np.sin(q) + 0.5 * np.sin(2.1 * t))
# A tank of first order: stronger than believed, four cycles and half a second late, it leaks by the root of its level.
TANK = Known(
    1,
    np.array([[1.7]]),
    (4,),
    (0.5,),
    0.02,
    lambda t, q, v: -0.3 * np.sqrt(np.maximum(q + 0.5, 0.0)) + (0.15 if 30 < t < 50 else 0.0),
    period=0.1,
)
TRUTH = {"stage": STAGE, "pendulum": PENDULUM, "vessel": TANK}
KNOWN: dict[str, Callable[[], fp.Problem]] = {
    "stage": lambda: task(STAGE, ("x", "y"), (0.32, 0.45), 60.0, (100.0, 5.0)),
    "pendulum": lambda: task(PENDULUM, ("angle",), (0.3,), 80.0, (100.0, 5.0)),
    "vessel": lambda: task(TANK, ("level",), (0.05,), 4.0, (0.25,)),
}
