"""Bodies with known answers: q'' = Lambda lag(u(t - d T)) - .5 v - 2 sin(q) + sin(1.3 t + k); the model is q'' = u."""

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

import fpirhc as fp

PERIOD = 1e-2
RHC = fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-2))


@dataclass
class Body:
    """A body with a gain matrix, a dead time in cycles, a lag in s, and a noise of the measured response."""

    gains: np.ndarray
    dead: int = 0
    lag: float = 0.0
    noise: float = 0.0

    def reset(self, seed: int) -> np.ndarray:
        n = len(self.gains)
        self.random, self.queue = np.random.default_rng(seed), [np.zeros(n)] * self.dead
        self.moving, self.now = cycle(tuple(map(tuple, self.gains)), self.lag), np.zeros(3 * n)
        return np.zeros(3 * n)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        self.queue.append(command)
        moved, response = (one.full().ravel() for one in self.moving(time, self.now, self.queue.pop(0)))
        self.now = moved
        noise = self.noise * self.random.standard_normal(len(response))
        return np.concatenate([moved[: 2 * len(response)], response + noise])


@cache
def cycle(gains: tuple[tuple[float, ...], ...], lag: float) -> ca.Function:
    """Function (time, [q, v, acting command], command) -> (the same a cycle later, response), in ten steps."""
    n, h = len(gains), PERIOD / 10
    time, moving, now = ca.SX.sym("t"), ca.SX.sym("x", 3 * n), ca.SX.sym("u", n)
    q, v, acting = ca.vertsplit(moving, n)
    for i in range(10):
        acting = now + (acting - now) * (np.exp(-h / lag) if lag else 0.0)
        push = ca.sin(1.3 * (time + i * h) + np.arange(n))
        a = ca.mtimes(ca.DM(gains), acting) - 0.5 * v - 2 * ca.sin(q) + push
        q, v = q + h * v + h * h / 2 * a, v + h * a
    return ca.Function("cycle", [time, moving, now], [ca.vertcat(q, v, acting), a])


def body_problem(gains: float | list[list[float]], dead: int = 0, lag: float = 0.0, noise: float = 0.0) -> fp.Problem:
    """Return the task of such a body, with the model of one or two masses."""
    body = Body(np.atleast_2d(np.array(gains, dtype=float)), dead, lag, noise)
    names, inputs = ["q", "p"][: len(body.gains)], ["u", "w"][: len(body.gains)]
    model = fp.Plant(
        dict.fromkeys(names, "m"),
        dict.fromkeys(inputs, "m/s^2"),
        {"b": fp.Parameter(1.0, 1.0, "1")},
        lambda q, v, u, p: {name: p.b * u[i] for name, i in zip(names, inputs, strict=True)},
    )
    units = {"": "m", "'": "m/s", "''": "m/s^2"}
    return fp.Problem(
        plant=model,
        reality=fp.ExternalPlant(body, measures={name + d: unit for d, unit in units.items() for name in names}),
        reference=fp.Trajectory(lambda t: {name: 1 - ca.cos((2 + k) * t) for k, name in enumerate(names)}),
        start=dict.fromkeys(names, 0.0),
        period=PERIOD,
        duration=8.0,
        measure_from=1.0,
        limits=fp.Limits(inputs=dict.fromkeys(inputs, (-60.0, 60.0))),
        horizon=fp.Horizon(stages=20, step=5e-2),
        cost=fp.Quadratic(
            states={**dict.fromkeys(names, 100.0), **{f"{n}'": 5.0 for n in names}},
            deviation=dict.fromkeys(inputs, 1.0),
        ),
    )
