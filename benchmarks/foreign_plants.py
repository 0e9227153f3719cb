"""Fourteen plants of textbooks and of other tools' examples under a wrong model: comparisons beside an independent integration.

Each is written as a user would write it, from its source. `by_hand` runs the same loop without the library: scipy integrates the
user's own equations, a root finder inverts them, and the tracking law and the model-referenced affine map are a few lines:

    d_k     = y^(r),N + sum_s C(r, s) rate^(r-s) (y^(s),N - y^(s))
    delta_k = delta_{k-1} + A_c / 2 (f_k - f^_k + delta_{k-1})
    u_k     = inverse of the model at d_k + delta_k, clipped

`chain` gives the derivatives of an output, differentiated by hand. `planned_by_hand` does the same with plans of IPOPT. The
equations are the sources'; the wrong parameters, the tasks, and numbers that a source leaves open are ours.
Run: .venv/bin/python benchmarks/foreign_plants.py [NAME ...]
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import comb, pi
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root

import fpirhc as fp
from fpirhc.controllers.contract import Controller
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.comparison.compare import compare
from fpirhc.studies.comparison.comparison import Comparison

State = Mapping[str, float]
Chain = Callable[[State, Any, Any], dict[str, tuple[float, ...]]]


@dataclass(frozen=True, eq=False)
class ForeignPlant:
    """A plant with its task and its two controllers' settings.

    Args:
        problem: the task.
        rate: Lambda of the tracking law; for a map (1 - z) / T.
        gain: A_c of the affine map.
        chain: (state, inputs, parameters) -> every controlled output with its derivatives; None: the coordinates.
    """

    problem: fp.Problem
    rate: float
    gain: float = -1.0
    chain: Chain | None = None

    @property
    def controllers(self) -> dict[str, Controller]:
        """Computed torque without and with adaptation."""
        law = fp.ComputedTorque(fp.Exponential(rate=self.rate, integral=False))
        return {"CTC": law, "CTC+FPI": law.with_deformation(fp.ModelReferenced(fp.Affine(gain=self.gain)))}

    def compared(self, name: str) -> Comparison:
        """The comparison that `fpirhc compare` shows."""
        task = Task(name, Path(f"{name}.py"), name, "", self.problem, self.controllers)
        return compare(task, seed=0, compiled=False)


def cruise() -> ForeignPlant:
    """Speed of a car in fourth gear on a hill of 4 deg (K. J. Astrom, R. M. Murray, Feedback Systems, 2nd ed. 2021, section 4.1).

    Numbers of python-control's examples/cruise-control.py. The model has the light car, the plant the loaded one, and nobody tells
    the hill.
    """

    def response(q, u, p):
        torque = 190 * (1 - 0.4 * (12 * q.speed / 420 - 1) ** 2)
        drag = 9.8 * p.mass * 0.01 + 0.5 * 1.3 * p.drag * 2.4 * q.speed**2
        return {"speed": (12 * torque * u.throttle - drag) / p.mass - 9.8 * ca.sin(p.slope)}

    plant = fp.Plant(
        coordinates={"speed": "m/s"},
        inputs={"throttle": "1"},
        order=1,
        response=response,
        parameters=known(mass=(1200.0, 1600.0, "kg"), drag=(0.25, 0.32, "1"), slope=(0.0, 4 * pi / 180, "rad")),
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"speed": 20 + ca.sin(0.3 * t)}),
            start={"speed": 20.0},
            period=0.05,
            duration=30.0,
            measure_from=5.0,
            limits=fp.Limits(inputs={"throttle": (0.0, 1.0)}),
        ),
        rate=0.5,
    )


def steering() -> ForeignPlant:
    """Lateral position of a car by its front wheels (Astrom and Murray, example 3.11; python-control, steering-optimal.py)."""

    def rates(x, u, p):
        return {"y": p.speed * ca.sin(x.heading), "heading": p.speed / p.wheelbase * ca.tan(u.steer)}

    def chain(x, u, p):
        climb = p.speed * np.cos(x["heading"])
        return {"lateral": (x["y"], p.speed * np.sin(x["heading"]), climb * p.speed / p.wheelbase * np.tan(u.steer))}

    plant = fp.Plant.of_states(
        states={"y": "m", "heading": "rad"},
        inputs={"steer": "rad"},
        parameters=known(speed=(8.0, 10.0, "m/s"), wheelbase=(3.5, 3.0, "m")),
        rates=rates,
        outputs={"lateral": fp.Output("m", lambda x, p: x.y)},
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"lateral": 2 * ca.sin(0.5 * t)}),
            start={"y": 0.0, "heading": 0.0},
            period=0.02,
            duration=20.0,
            measure_from=5.0,
            limits=fp.Limits(inputs={"steer": (-0.5, 0.5)}),
        ),
        rate=1.5,
        chain=chain,
    )


def servomechanism() -> ForeignPlant:
    """A motor's arm against a spring (python-control, docs, nonlinear systems, `servomech`: J = 100, b = 10, k r = 1)."""

    def response(q, v, u, p):
        return {"angle": (u.torque - p.damping * v.angle - p.stiffness * ca.sin(q.angle)) / p.inertia}

    plant = fp.Plant(
        coordinates={"angle": "rad"},
        inputs={"torque": "N m"},
        response=response,
        parameters=known(inertia=(80.0, 100.0, "kg m^2"), damping=(4.0, 10.0, "N m s"), stiffness=(0.0, 1.0, "N m")),
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"angle": ca.sin(0.2 * t)}),
            start={"angle": 0.0, "angle'": 0.1},
            period=0.05,
            duration=60.0,
            measure_from=10.0,
            limits=fp.Limits(inputs={"torque": (-50.0, 50.0)}),
        ),
        rate=0.8,
    )


def pvtol() -> ForeignPlant:
    """Height and tilt of a planar vertical take-off aircraft (python-control, examples/pvtol.py); it drifts sideways meanwhile."""

    def response(q, v, u, p):
        sin, cos = ca.sin(q.tilt), ca.cos(q.tilt)
        return {
            "x": (u.side * cos - u.lift * sin - 0.05 * v.x) / p.mass,
            "z": (u.side * sin + u.lift * cos - 0.05 * v.z) / p.mass - 9.8,
            "tilt": p.arm * u.side / p.inertia,
        }

    plant = fp.Plant(
        coordinates={"x": "m", "z": "m", "tilt": "rad"},
        inputs={"side": "N", "lift": "N"},
        controlled=("z", "tilt"),
        response=response,
        parameters=known(mass=(3.5, 4.0, "kg"), inertia=(0.06, 0.0475, "kg m^2"), arm=(0.25, 0.25, "m")),
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"x": 0 * t, "z": ca.sin(t), "tilt": 0.2 * ca.sin(0.8 * t)}),
            start={"x": 0.0, "z": 0.0, "tilt": 0.0, "z'": 1.0},
            period=0.01,
            duration=10.0,
            measure_from=2.0,
            limits=fp.Limits(inputs={"side": (-3.92, 3.92), "lift": (0.0, 58.8)}),
        ),
        rate=3.0,
    )


def conical_tank() -> ForeignPlant:
    """Level of a conical tank (D. E. Seborg et al., Process Dynamics and Control, 4th ed. 2016, ch. 2; B. W. Bequette, 1998)."""

    def response(q, u, p):
        return {"level": (u.inflow - p.valve * ca.sqrt(q.level)) / (pi * (p.slope * q.level) ** 2)}

    plant = fp.Plant(
        coordinates={"level": "m"},
        inputs={"inflow": "m^3/min"},
        order=1,
        response=response,
        parameters=known(valve=(0.35, 0.5, "m^2.5/min"), slope=(0.5, 0.4, "1")),
        ranges={"level": (0.05, 4.0)},
        time_unit="min",
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"level": 1.5 + 0.5 * ca.sin(0.5 * t)}),
            start={"level": 1.2},
            period=0.05,
            duration=30.0,
            measure_from=5.0,
            limits=fp.Limits(inputs={"inflow": (0.0, 3.0)}),
            input_before={"inflow": 0.5},
        ),
        rate=1.0,
    )


def magnet() -> ForeignPlant:
    """A ball below an electromagnet, by its current i, squared (H. K. Khalil, Nonlinear Systems, 3rd ed. 2002, exercise 1.18)."""

    def response(q, v, u, p):
        force = p.inductance * u.current**2 / (2 * 0.05 * (1 + q.gap / 0.05) ** 2)
        return {"gap": 9.81 - (0.001 * v.gap + force) / p.mass}

    plant = fp.Plant(
        coordinates={"gap": "m"},
        inputs={"current": "A"},
        response=response,
        parameters=known(mass=(0.1, 0.12, "kg"), inductance=(0.01, 0.009, "H")),
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"gap": 0.05 + 0.01 * ca.sin(4 * t)}),
            start={"gap": 0.05, "gap'": 0.04},
            period=2e-3,
            duration=4.0,
            measure_from=1.0,
            limits=fp.Limits(inputs={"current": (0.5, 12.0)}),
            input_before={"current": 6.3},
        ),
        rate=15.0,
        gain=-0.6,
    )


def underwater() -> ForeignPlant:
    """An underwater vehicle with quadratic drag (J.-J. E. Slotine, W. Li, Applied Nonlinear Control, 1991, section 7.1)."""

    def response(_, v, u, p):
        return {"x": (u.thrust - p.drag * v.x * ca.fabs(v.x)) / p.mass}

    plant = fp.Plant(
        coordinates={"x": "m"},
        inputs={"thrust": "N"},
        response=response,
        parameters=known(mass=(2.0, 3.0, "kg"), drag=(0.5, 1.2, "kg/m")),
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"x": 2 * ca.sin(0.6 * t)}),
            start={"x": 0.0},
            period=0.02,
            duration=25.0,
            measure_from=5.0,
            limits=fp.Limits(inputs={"thrust": (-10.0, 10.0)}),
        ),
        rate=1.2,
    )


def rocket() -> ForeignPlant:
    """A rocket that loses mass, along a course of its height (CasADi, docs/examples/python/rocket.py: drag .05, consumption .1)."""

    def rates(x, u, p):
        return {"s": x.v, "v": (u.thrust - p.drag * x.v**2) / x.m, "m": -p.consumption * u.thrust**2}

    def chain(x, u, p):
        return {"height": (x["s"], x["v"], (u.thrust - p.drag * x["v"] ** 2) / x["m"])}

    plant = fp.Plant.of_states(
        states={"s": "m", "v": "m/s", "m": "kg"},
        inputs={"thrust": "N"},
        parameters=known(drag=(0.01, 0.05, "kg/m"), consumption=(0.1, 0.1, "kg/(N^2 s)")),
        rates=rates,
        outputs={"height": fp.Output("m", lambda x, p: x.s)},
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(
                lambda t: {"height": 10 * (10 * (t / 10) ** 3 - 15 * (t / 10) ** 4 + 6 * (t / 10) ** 5)}
            ),
            start={"s": 0.0, "v": 0.0, "m": 1.0},
            period=0.02,
            duration=10.0,
            measure_from=1.0,
            limits=fp.Limits(inputs={"thrust": (-1.1, 1.1)}),
        ),
        rate=1.5,
        chain=chain,
    )


def unicycle() -> ForeignPlant:
    """Speed and heading of a robot (acados, examples/acados_python/unicycle, there with unit mass and inertia)."""

    def rates(x, u, p):
        return {
            "x": x.v * ca.cos(x.theta),
            "y": x.v * ca.sin(x.theta),
            "v": u.force / p.mass,
            "theta": x.turn,
            "turn": u.torque / p.inertia,
        }

    def chain(x, u, p):
        return {"speed": (x["v"], u.force / p.mass), "heading": (x["theta"], x["turn"], u.torque / p.inertia)}

    plant = fp.Plant.of_states(
        states={"x": "m", "y": "m", "v": "m/s", "theta": "rad", "turn": "rad/s"},
        inputs={"force": "N", "torque": "N m"},
        parameters=known(mass=(1.0, 1.4, "kg"), inertia=(1.0, 0.7, "kg m^2")),
        rates=rates,
        outputs={"speed": fp.Output("m/s", lambda x, p: x.v), "heading": fp.Output("rad", lambda x, p: x.theta)},
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"speed": 1 + 0.5 * ca.sin(t), "heading": ca.sin(0.7 * t)}),
            start={"x": 0.0, "y": 0.0, "v": 1.0, "theta": 0.0, "turn": 0.0},
            period=0.02,
            duration=15.0,
            measure_from=4.0,
            limits=fp.Limits(inputs={"force": (-10.0, 10.0), "torque": (-10.0, 10.0)}),
        ),
        rate=2.0,
        chain=chain,
    )


def masses() -> ForeignPlant:
    """Two oscillating masses as a map, the second one follows (do-mpc, examples/oscillating_masses_discrete)."""
    a = (
        (0.763, 0.460, 0.115, 0.020),
        (-0.899, 0.763, 0.420, 0.115),
        (0.115, 0.020, 0.763, 0.460),
        (0.420, 0.115, -0.899, 0.763),
    )
    b, names = (0.014, 0.063, 0.221, 0.367), ("x1", "v1", "x2", "v2")

    def following(x, u, p):
        own = (x.x1, x.v1, x.x2, x.v2)
        sums = (sum(c * e for c, e in zip(row, own, strict=True)) for row in a)
        return {name: one + k * p.effect * u.force for name, one, k in zip(names, sums, b, strict=True)}

    def chain(x, u, p):
        row = sum(c * x[name] for c, name in zip(a[2], names, strict=True))
        return {"second": (x["x2"], (row + b[2] * p.effect * u.force - x["x2"]) / 0.5)}

    plant = fp.Plant.discrete(
        states=dict.fromkeys(names, "m"),
        inputs={"force": "N"},
        parameters=known(effect=(1.4, 1.0, "1")),
        next=following,
        step=0.5,
        outputs={"second": fp.Output("m", lambda x, p: x.x2)},
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"second": ca.sin(0.1 * t)}),
            start=dict.fromkeys(names, 0.0),
            period=0.5,
            duration=100.0,
            measure_from=10.0,
            limits=fp.Limits(inputs={"force": (-10.0, 10.0)}),
        ),
        rate=1.0,
        chain=chain,
    )


def generator() -> ForeignPlant:
    """Angle of a synchronous generator by its field voltage, order 3 (Khalil, Nonlinear Systems, 3rd ed., exercise 1.8)."""

    def rates(x, u, p):
        return {
            "delta": x.w,
            "w": (p.power - 0.0588 * x.w - p.coupling * x.e * ca.sin(x.delta)) / 0.0147,
            "e": (u.field + 1.7 * ca.cos(x.delta) - 2.7 * x.e) / p.tau,
        }

    def chain(x, u, p):
        sin, cos = np.sin(x["delta"]), np.cos(x["delta"])
        w = (p.power - 0.0588 * x["w"] - p.coupling * x["e"] * sin) / 0.0147
        e = (u.field + 1.7 * cos - 2.7 * x["e"]) / p.tau
        jerk = (-0.0588 * w - p.coupling * (e * sin + x["e"] * cos * x["w"])) / 0.0147
        return {"angle": (x["delta"], x["w"], w, jerk)}

    plant = fp.Plant.of_states(
        states={"delta": "rad", "w": "rad/s", "e": "1"},
        inputs={"field": "1"},
        parameters=known(power=(0.815, 0.75, "1"), coupling=(2.0, 1.8, "1"), tau=(6.6, 5.5, "s")),
        rates=rates,
        outputs={"angle": fp.Output("rad", lambda x, p: x.delta)},
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"angle": 0.5 + 0.1 * ca.sin(t)}),
            start={"delta": 0.5, "w": 0.1, "e": 0.87},
            period=5e-3,
            duration=8.0,
            measure_from=3.0,
            limits=fp.Limits(inputs={"field": (-20.0, 20.0)}),
        ),
        rate=3.0,
        gain=-0.6,
        chain=chain,
    )


def ball_and_beam() -> ForeignPlant:
    """The ball's place by the beam's torque (J. Hauser, S. Sastry, P. Kokotovic, IEEE TAC 37(3), 1992): no relative degree at rest.

    The third derivative has the input through 2 B r theta' u alone, which vanishes on the way: the problem is refused.
    """

    def rates(x, u, p):
        return {
            "r": x.v,
            "v": p.ratio * (x.r * x.w**2 - 9.81 * ca.sin(x.theta)),
            "theta": x.w,
            "w": u.torque / p.inertia,
        }

    plant = fp.Plant.of_states(
        states={"r": "m", "v": "m/s", "theta": "rad", "w": "rad/s"},
        inputs={"torque": "N m"},
        parameters=known(ratio=(0.7143, 0.6, "1"), inertia=(0.02, 0.025, "kg m^2")),
        rates=rates,
        outputs={"place": fp.Output("m", lambda x, p: x.r)},
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(lambda t: {"place": 0.1 + 0.3 * ca.sin(0.6 * t)}),
            start={"r": 0.1, "v": 0.18, "theta": 0.0, "w": 0.5},
            period=0.01,
            duration=10.0,
            measure_from=2.0,
            limits=fp.Limits(inputs={"torque": (-1.0, 1.0)}),
        ),
        rate=2.0,
    )


def blending() -> ForeignPlant:
    """Volume and composition of a stirred blending tank by its two feeds (Seborg et al., section 2.2).

    V' = (w1 + w2 - w) / rho,  x' = (w1 (x1 - x) + w2 (x2 - x)) / (V rho); the model has wrong compositions of the feeds.
    """

    def rates(x, u, p):
        return {"V": (u.w1 + u.w2 - p.w) / p.rho, "x": (u.w1 * (p.x1 - x.x) + u.w2 * (p.x2 - x.x)) / (x.V * p.rho)}

    def chain(x, u, p):
        feed = u.w1 * (p.x1 - x["x"]) + u.w2 * (p.x2 - x["x"])
        return {
            "level": (x["V"] / 0.8, (u.w1 + u.w2 - p.w) / p.rho / 0.8),
            "percent": (100 * x["x"], 100 * feed / (x["V"] * p.rho)),
        }

    plant = fp.Plant.of_states(
        states={"V": "m^3", "x": "1"},
        inputs={"w1": "kg/min", "w2": "kg/min"},
        parameters=known(
            rho=(900.0, 900.0, "kg/m^3"), w=(620.0, 700.0, "kg/min"), x1=(0.45, 0.4, "1"), x2=(0.7, 0.75, "1")
        ),
        rates=rates,
        outputs={"level": fp.Output("m", lambda x, p: x.V / 0.8), "percent": fp.Output("1", lambda x, p: 100 * x.x)},
        time_unit="min",
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(
                lambda t: {"level": 2.5 + 0.2 * ca.sin(0.2 * t), "percent": 50 + 3 * ca.sin(0.3 * t)}
            ),
            start={"V": 2.0, "x": 0.5},
            period=0.05,
            duration=40.0,
            measure_from=15.0,
            limits=fp.Limits(inputs={"w1": (0.0, 2000.0), "w2": (0.0, 2000.0)}),
        ),
        rate=0.5,
        chain=chain,
    )


def stocking() -> ForeignPlant:
    """Adult and young fish by fishing and by setting out young ones, a map (Beverton and Holt 1957; stages as in H. Caswell 2001).

    A+ = s A + m J - q A e,  J+ = b A / (1 + A / K) + u.
    """

    def following(x, u, p):
        return {
            "adults": p.s * x.adults + p.m * x.young - p.q * x.adults * u.effort,
            "young": p.b * x.adults / (1 + x.adults / p.K) + u.stocked,
        }

    def chain(x, u, p):
        adults = p.s * x["adults"] + p.m * x["young"] - p.q * x["adults"] * u.effort
        young = p.b * x["adults"] / (1 + x["adults"] / p.K) + u.stocked
        return {"adults": (x["adults"], adults - x["adults"]), "young": (x["young"], young - x["young"])}

    plant = fp.Plant.discrete(
        states={"adults": "kt", "young": "kt"},
        inputs={"effort": "kd", "stocked": "kt"},
        parameters=known(
            s=(0.7, 0.8, "1"), m=(0.6, 0.5, "1"), q=(0.3, 0.4, "1/kd"), b=(0.8, 1.0, "1"), K=(60.0, 50.0, "kt")
        ),
        next=following,
        step=1.0,
        outputs={"adults": fp.Output("kt", lambda x, p: x.adults), "young": fp.Output("kt", lambda x, p: x.young)},
        time_unit="year",
    )
    return ForeignPlant(
        fp.Problem(
            plant=plant,
            reference=fp.Trajectory(
                lambda t: {"adults": 60.0 + 8.0 * ca.sin(0.2 * t), "young": 40.0 + 4.0 * ca.sin(0.3 * t)}
            ),
            start={"adults": 55.0, "young": 38.0},
            period=1.0,
            duration=80.0,
            measure_from=20.0,
            limits=fp.Limits(inputs={"effort": (0.0, 3.0), "stocked": (0.0, 100.0)}),
        ),
        rate=0.5,
        chain=chain,
    )


PLANTS: dict[str, Callable[[], ForeignPlant]] = {
    one.__name__: one
    for one in (
        *(cruise, steering, servomechanism, pvtol, conical_tank, magnet),
        *(underwater, rocket, unicycle, masses, generator, ball_and_beam),
        *(blending, stocking),
    )
}


def known(**values: tuple[float, float, str]) -> dict[str, fp.Parameter]:
    """Parameters from (approximate, exact, unit)."""
    return {name: fp.Parameter(*value) for name, value in values.items()}


# --- The independent loop ---------------------------------------------------------------------------------------------


def by_hand(one: ForeignPlant, *, adaptive: bool) -> dict[str, np.ndarray]:
    """Return the errors of the controlled quantities at the beginning of every cycle, by name."""
    problem, plant = one.problem, one.problem.plant
    model, exact = (_parameters(plant, which) for which in ("approximate", "exact"))
    low, high = (np.array(ends) for ends in zip(*(problem.limits.inputs[name] for name in plant.inputs), strict=True))
    x, u = np.array([problem.start.get(e, 0.0) for e in plant.state.elements]), problem.inputs_before
    delta: np.ndarray | None = None
    seen, errors = None, []
    for cycle in range(problem.cycles):
        measured = _chain(one, x, u, exact)
        desired, error = _desired(one, measured, cycle * problem.period)
        errors.append(error)
        if plant.step is None and cycle:
            seen = (_last(measured), _last(_chain(one, x, u, model)))
        delta = _delta(one.gain, delta, seen) if adaptive else None
        wanted = desired + (0.0 if delta is None else delta)
        u = root(lambda v, x=x, wanted=wanted: _last(_chain(one, x, v, model)) - wanted, u, tol=1e-13).x
        u = np.clip(u, low, high)
        if plant.step is not None:  # a map's response is known when its step is done
            seen = (_last(_chain(one, x, u, exact)), _last(_chain(one, x, u, model)))
        x = _moved(one, x, u, exact)
    return {name: np.array([e[name] for e in errors]) for name in errors[0]}


def _delta(gain: float, before: np.ndarray | None, seen: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray | None:
    """The next deformation; None before anything was seen."""
    if seen is None:
        return None
    before = np.zeros_like(seen[0]) if before is None else before
    return before + 0.5 * gain * (seen[0] - seen[1] + before)


def _desired(
    one: ForeignPlant, measured: Mapping[str, tuple[float, ...]], t: float
) -> tuple[np.ndarray, dict[str, float]]:
    """The tracking law's response and the errors."""
    responses, errors = [], {}
    for name, values in measured.items():
        order = len(values) - 1
        nominal = _nominal(one.problem, name, order, t)
        gains = [comb(order, s) * one.rate ** (order - s) for s in range(order)]
        responses.append(nominal[order] + sum(k * (nominal[s] - values[s]) for s, k in enumerate(gains)))
        errors[name] = nominal[0] - values[0]
    return np.array(responses), errors


def _nominal(problem: fp.Problem, name: str, order: int, t: float) -> list[float]:
    """The reference and its derivatives, or its differences on a map, by differentiating the user's own expression."""
    symbol = ca.SX.sym("t")
    motion = problem.reference.motion  # type: ignore[attr-defined]  # every reference here is a Trajectory
    value = motion(symbol)[name]
    if problem.plant.step is not None:
        ahead = [float(ca.evalf(ca.substitute(value, symbol, t + k * problem.plant.step))) for k in (0, 1)]
        return [ahead[0], (ahead[1] - ahead[0]) / problem.plant.step]
    values = []
    for _ in range(order + 1):
        values.append(float(ca.evalf(ca.substitute(value, symbol, t))))
        value = ca.gradient(value, symbol)
    return values


def _parameters(plant: fp.Plant, which: str) -> SimpleNamespace:
    return SimpleNamespace(**{name: getattr(one, which) for name, one in plant.parameters.items()})


def _named(names: Mapping[str, str], values: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip(names, map(float, values), strict=True)))


def _rates(plant: fp.Plant, x: np.ndarray, u: np.ndarray, p: SimpleNamespace) -> dict[str, float]:
    """The user's own function, in numbers; of a map the next state."""
    count = len(plant.coordinates)
    lower = [_named(plant.coordinates, x[k : k + count]) for k in range(0, len(x), count)]
    function = plant.response if plant.step is None else plant.next
    assert function is not None
    return {name: float(value) for name, value in function(*lower, _named(plant.inputs, u), p).items()}


def _chain(one: ForeignPlant, x: np.ndarray, u: np.ndarray, p: SimpleNamespace) -> dict[str, tuple[float, ...]]:
    """Every controlled quantity with its derivatives."""
    plant = one.problem.plant
    state = dict(zip(plant.state.elements, map(float, x), strict=True))
    if one.chain is not None:
        return one.chain(state, _named(plant.inputs, u), p)
    rates, order = _rates(plant, x, u, p), plant.orders[0]
    return {c: (*(state[c + "'" * k] for k in range(order)), rates[c]) for c in plant.controlled_names}


def _last(chain: Mapping[str, tuple[float, ...]]) -> np.ndarray:
    """The highest derivatives."""
    return np.array([values[-1] for values in chain.values()])


def _moved(one: ForeignPlant, x: np.ndarray, u: np.ndarray, p: SimpleNamespace) -> np.ndarray:
    """The state one cycle later."""
    plant, count = one.problem.plant, len(one.problem.plant.coordinates)
    if plant.step is not None:
        return np.array(list(_rates(plant, x, u, p).values()))

    def derivative(_: float, state: np.ndarray) -> np.ndarray:
        return np.concatenate([state[count:], list(_rates(plant, state, u, p).values())])

    return np.asarray(
        solve_ivp(derivative, (0, one.problem.period), x, method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    )


def plans(one: ForeignPlant) -> tuple[fp.Problem, Controller]:
    """The task of a plant of order 2 with plans of fifteen stages, one per cycle of 0.1 s."""
    [name], [force] = one.problem.plant.coordinates, one.problem.plant.inputs
    problem = replace(
        one.problem,
        period=0.1,
        horizon=fp.Horizon(stages=_STAGES, step=0.1),
        cost=fp.Quadratic(states={name: _WEIGHTS[0], f"{name}'": _WEIGHTS[1]}, effort={force: _WEIGHTS[2]}),
    )
    return problem, fp.RecedingHorizon(fp.FixedPoint(iterations=200, tolerance=1e-9))


def planned_by_hand(one: ForeignPlant, problem: fp.Problem) -> np.ndarray:
    """Return the errors of the only coordinate under plans that CasADi's Opti and IPOPT make."""
    plant, opti = problem.plant, ca.Opti()
    [name], [force] = plant.coordinates, plant.inputs
    model, exact = (_parameters(plant, which) for which in ("approximate", "exact"))
    u, start, wanted = opti.variable(_STAGES), opti.parameter(2), opti.parameter(2, _STAGES + 1)

    def slope(s: ca.MX, command: ca.MX) -> ca.MX:
        q, v = SimpleNamespace(**{name: s[0]}), SimpleNamespace(**{name: s[1]})
        return ca.vertcat(s[1], plant.response(q, v, SimpleNamespace(**{force: command}), model)[name])

    s, cost, h = start, 0, problem.period
    for k in range(_STAGES + 1):
        error = s - wanted[:, k]
        cost += h * (_WEIGHTS[0] * error[0] ** 2 + _WEIGHTS[1] * error[1] ** 2)
        if k < _STAGES:
            cost += h * _WEIGHTS[2] * u[k] ** 2
            k1 = slope(s, u[k])
            k2 = slope(s + h / 2 * k1, u[k])
            k3 = slope(s + h / 2 * k2, u[k])
            s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(s + h * k3, u[k]))
    opti.minimize(cost)
    opti.subject_to(opti.bounded(*(problem.limits.inputs[force][0], u, problem.limits.inputs[force][1])))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-12})
    x, errors = np.array([problem.start.get(e, 0.0) for e in plant.state.elements]), []
    for cycle in range(problem.cycles):
        course = [_nominal(problem, name, 1, (cycle + k) * h) for k in range(_STAGES + 1)]
        errors.append(course[0][0] - x[0])
        opti.set_value(start, x)
        opti.set_value(wanted, np.array(course).T)
        solution = opti.solve()
        opti.set_initial(solution.value_variables())
        x = _moved(replace(one, problem=problem), x, np.array([solution.value(u)[0]]), exact)
    return np.array(errors)


_STAGES, _WEIGHTS = 15, (10.0, 1.0, 0.01)  # of a plan: position, speed, force


def rms_by_hand(one: ForeignPlant, *, adaptive: bool) -> dict[str, float]:
    """Return the rms errors from `measure_from` on."""
    first = round(one.problem.measure_from / one.problem.period)
    return {name: float(np.sqrt(np.mean(e[first:] ** 2))) for name, e in by_hand(one, adaptive=adaptive).items()}


def main() -> None:
    """Print verdict, errors beside the independent ones, and the review's answers other than yes."""
    for name in sys.argv[1:] or PLANTS:
        print(f"== {name}: {(PLANTS[name].__doc__ or '').partition(chr(10))[0]}")
        try:
            one = PLANTS[name]()
        except fp.FpirhcError as error:
            print(f"   refused: {error}")
            continue
        comparison = one.compared(name)
        for entry in comparison.entries:
            for quantity, rms in rms_by_hand(one, adaptive=entry.name != "CTC").items():
                print(f"   {entry.name:8s} {quantity}: {entry.metrics.rms_error[quantity]:.6g}, by hand {rms:.6g}")
        for text, outcome in comparison.sentences:
            print(f"   [{outcome or ''}] {text}")
        review = fp.review(one.problem, one.controllers, mismatch=0.0, seed=0)
        for group, answers in {"problem": review.problem, **review.controllers}.items():
            for answer in (a for a in answers if a.verdict != "yes"):
                print(f"   {group}: {answer.verdict} {answer.question} {answer.evidence} -> {answer.change}")


if __name__ == "__main__":
    main()
