"""AdaptiveQuadBench: a quadrotor that is given motor speeds, on the benchmark's own paired trials, behind a point mass.

The vehicle (RotorPy's equations, 17 states) starts at rest with its rotors at rest, and follows a random minimum-jerk motion for
5 s through wind, switched forces and torques, payloads, weak rotors, or with a flight controller that believes wrong parameters.
The model is r'' = thrust - g; an attitude loop of nominal parameters turns the thrust. Nobody is told what disturbs: the response
is the difference of the measured velocity. One setting serves all trials.

`fpirhc study problems/outside/quadbench/quadbench.py --cases all` flies the trials; `benchmarks/quadbench.py` prints the table.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import draws
import numpy as np
import vehicle

import fpirhc as fp
from fpirhc.task.reference import Reference

AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class ToGoal(Reference):
    """From rest at the origin to a position, velocity and acceleration at the time T, with the least integral of squared jerk.

    r = c3 t^3 + c4 t^4 + c5 t^5 by axis; [c3, c4, c5] solve r(T), r'(T), r''(T) of the goal. Numbers of the goal may be live.
    """

    position: Mapping[str, float]
    velocity: Mapping[str, float]
    acceleration: Mapping[str, float]

    def coordinates(self, t):
        """Return the three polynomials."""
        powers, end = np.arange(3, 6), draws.LENGTH
        rows = [end**powers, powers * end ** (powers - 1), powers * (powers - 1) * end ** (powers - 2)]
        solved = np.linalg.inv(np.array(rows))
        goal = {n: (self.position[n], self.velocity[n], self.acceleration[n]) for n in AXES}
        weights = {n: [sum(float(s) * g for s, g in zip(row, goal[n], strict=True)) for row in solved] for n in AXES}
        return {n: sum(c * t ** int(k) for c, k in zip(weights[n], powers, strict=True)) for n in AXES}


plant = fp.Plant(
    coordinates=dict.fromkeys(AXES, "m"),
    inputs={f"thrust_{n}": "m/s^2" for n in AXES},
    parameters={"g": fp.Parameter(approximate=9.81, exact=9.81, unit="m/s^2")},
    response=lambda _q, _v, u, p: {"x": u.thrust_x, "y": u.thrust_y, "z": u.thrust_z - p.g},
)
reality = fp.ExternalPlant(
    make=lambda told, _seed: vehicle.Vehicle(told),
    measures={n + dash: unit for dash, unit in {"": "m", "'": "m/s"}.items() for n in AXES},
    parameters={n: fp.Parameter(value, value, unit) for n, (value, unit) in draws.NUMBERS.items()},
)
still = dict.fromkeys(AXES, 0.0)
problem = fp.Problem(
    plant=plant,
    reality=reality,
    reference=ToGoal({"x": 1.0, "y": -1.0, "z": 1.0}, still, still),
    sensing=fp.Sensing(estimator=fp.VelocityDifference()),
    start=still,
    period=vehicle.PERIOD,
    duration=draws.LENGTH,
    # With less thrust than half of its weight the rotors have no room left to turn the vehicle.
    limits=fp.Limits(inputs={"thrust_x": (-12.0, 12.0), "thrust_y": (-12.0, 12.0), "thrust_z": (5.0, 30.0)}),
    horizon=fp.Horizon(stages=20, step=1e-2, lengths=tuple(1.15**k for k in range(20))),  # 1 s
    cost=fp.Quadratic(
        states={**dict.fromkeys(AXES, 100.0), **{f"{n}'": 5.0 for n in AXES}},
        deviation=dict.fromkeys(plant.inputs, 1.0),
    ),
)

GAIN, UPWARDS = -0.1, 1.8  # upwards only the motors lag, so the height bears more
optimiser = fp.FixedPointSolver(
    iterations=1, tolerance=1e-2
)  # m/s^2; the real-time form: a flight computer has the same work in every cycle
law = fp.Exponential(rate=3.0, integral=False)
form = fp.ModelReferenced(fp.Affine(gain=GAIN, weights=(1.0, 1.0, UPWARDS)))
controllers = {
    "CTC": fp.ComputedTorque(law),
    "CTC+FPI": fp.ComputedTorque(law, form),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, form),
}
headline = ("RHC", "RHC+FPI")


def _case(family, told, goal):
    places = {f"reference.{what}.{n}": v for what, row in zip(("position", "velocity", "acceleration"), goal, strict=True)
              for n, v in zip(AXES, row, strict=True)}  # fmt: skip
    return {"group": family, **{f"exact.{name}": value for name, value in told.items()}, **places}


cases = fp.Cases(
    {
        f"{family} {k}": _case(family, told, goal)
        for family in draws.FAMILIES
        for k, (told, goal) in enumerate(zip(*draws.trials(family), strict=True))
    }
)


def distance(_problem, run):
    """Root mean square of the distance to the reference over all cycles, m."""
    return float(np.sqrt(sum(np.mean(run[f"error.{n}"] ** 2) for n in AXES))) if run.stop is None else math.nan


metrics = (fp.Metric("distance", distance, unit="m", main=True),)
headline_metric = "distance"
