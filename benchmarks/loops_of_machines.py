"""Closed loops of machines with limits of states, from textbooks and other tools' examples; see `loops_of_processes.py`."""

from __future__ import annotations

import itertools

import casadi as ca
import numpy as np
from foreign import Foreign, known

import fpirhc as fp


def van_der_pol() -> Foreign:
    """Van der Pol's oscillator, x1 >= -.25, |u| <= 1 (CasADi, docs/examples/python/direct_multiple_shooting.py), here on a sine."""

    def response(q, u, p):
        return {"x1": (p.mu - q.x2**2) * q.x1 - q.x2 + u.u, "x2": q.x1}

    return Foreign(
        fp.Plant(
            coordinates={"x1": "1", "x2": "1"},
            inputs={"u": "1"},
            controlled=("x1",),
            order=1,
            response=response,
            parameters=known(mu=(1.0, 1.3, "1")),
        ),
        {"x1": 0.0, "x2": 1.0},
        fp.Trajectory(lambda t: {"x1": 0.35 * ca.cos(0.5 * t), "x2": 0.7 * ca.sin(0.5 * t)}),
        fp.Horizon(stages=20, step=0.25),
        fp.Quadratic(states={"x1": 1.0, "x2": 1.0}, effort={"u": 0.1}),
        fp.Limits(inputs={"u": (-1.0, 1.0)}, states={"x1": (-0.25, 1.0)}),
    )


def double_integrator() -> Foreign:
    """Double integrator with limited speed (F. Borrelli, A. Bemporad, M. Morari, Predictive Control, 2017, ch. 12)."""
    return Foreign(
        fp.Plant(
            coordinates={"x": "m"},
            inputs={"u": "m/s^2"},
            response=lambda q, v, u, p: {"x": p.gain * u.u - p.drag * v.x},
            parameters=known(gain=(1.0, 1.15, "1"), drag=(0.0, 0.1, "1/s")),
        ),
        {"x": -4.0},
        fp.Trajectory(lambda t: {"x": 4 * ca.tanh(6 * ca.sin(0.25 * t))}),
        fp.Horizon(stages=20, step=0.25),
        fp.Quadratic(states={"x": 1.0, "x'": 0.1}, effort={"u": 0.1}),
        fp.Limits(inputs={"u": (-1.0, 1.0)}, states={"x": (-4.2, 3.9), "x'": (-1.0, 1.0)}),
    )


def citation() -> Foreign:
    """Cessna Citation at 128.2 m/s changing its height (J. M. Maciejowski, Predictive Control with Constraints, 2002, example 2.7).

    Elevator within 15 degrees and 30 degrees/s, pitch within 20 degrees as there. The wrong model has too strong an elevator.
    """

    def response(q, u, p):
        elevator = 0.262 * u.elevator  # the input counts from -1 to 1
        return {
            "attack": -1.2822 * q.attack + 0.98 * q.rate - 0.3 * elevator,
            "pitch": q.rate,
            "rate": p.stiffness * q.attack - 1.8366 * q.rate + p.power * elevator,
            "height": 12.82 * (q.pitch - q.attack),
        }

    return Foreign(
        fp.Plant(
            coordinates={"attack": "rad", "pitch": "rad", "rate": "rad/s", "height": "10 m"},
            inputs={"elevator": "0.262 rad"},
            controlled=("rate",),
            order=1,
            response=response,
            parameters=known(stiffness=(-5.4293, -4.9, "1/s^2"), power=(-17.0, -15.0, "1/s^2")),
        ),
        {"attack": 0.0},
        fp.Trajectory(
            lambda t: {"attack": 0 * t, "pitch": 0 * t, "rate": 0 * t, "height": 20 * ca.tanh(3 * ca.sin(0.15 * t))}
        ),
        fp.Horizon(stages=20, step=0.25),
        fp.Quadratic(states={"height": 1.0, "pitch": 1.0}, effort={"elevator": 0.1}),
        fp.Limits(inputs={"elevator": (-1.0, 1.0)}, states={"pitch": (-0.349, 0.349)}, rates={"elevator": (-2.0, 2.0)}),
    )


def masses() -> Foreign:
    """Six masses between two walls, three actuators between them (Y. Wang, S. Boyd, IEEE Trans. CST 18(2), 2010, section V).

    Masses and springs of 1, no damping, |u| <= .5; a twin of do-mpc's oscillating_masses. A mass is pushed by a reference.
    """
    names = tuple(f"y{k}" for k in range(1, 7))
    pairs = {"u1": (0, 1), "u2": (2, 4), "u3": (3, 5)}

    def response(q, v, u, p):
        y = [0, *(q[n] for n in names), 0]
        force = [p.k * (y[k - 1] - 2 * y[k] + y[k + 1]) - p.d * v[names[k - 1]] for k in range(1, 7)]
        for name, (first, second) in pairs.items():
            force[first] += u[name]
            force[second] -= u[name]
        return dict(zip(names, force, strict=True))

    return Foreign(
        fp.Plant(
            coordinates=dict.fromkeys(names, "m"),
            inputs=dict.fromkeys(pairs, "N"),
            controlled=("y1", "y3", "y4"),
            response=response,
            parameters=known(k=(1.0, 1.1, "N/m"), d=(0.0, 0.05, "N s/m")),
        ),
        {"y1": 0.3, "y4": -0.3, "y5'": 0.3},
        fp.Trajectory(lambda t: {n: (1.5 * ca.sin(0.35 * t) if n in ("y1", "y6") else 0 * t) for n in names}),
        fp.Horizon(stages=30, step=0.5, discretisation=fp.RungeKutta4(2)),
        fp.Quadratic(states=dict.fromkeys(names, 1.0), effort=dict.fromkeys(pairs, 0.1)),
        fp.Limits(
            inputs=dict.fromkeys(pairs, (-0.5, 0.5)), states={**dict.fromkeys(names, (-0.45, 0.45)), "y1'": (-0.2, 0.2)}
        ),
    )


def discs() -> Foreign:
    """Three discs between two motors that lag (do-mpc, examples/rotating_oscillating_masses_mhe_mpc), angles limited.

    Springs, damping and lag of the source, inertias of 2.25e-4 kg m^2; one spring of the plant is 20 % stiffer than in the model.
    """
    springs, damping = (2.697, 2.66, 3.05, 2.86), (0.0678, 0.0801, 0.0882)  # mN m/rad, mN m s/rad

    def response(q, v, u, p):
        angles = [q.motor1, q.disc1, q.disc2, q.disc3, q.motor2]
        pull = [
            (p.stiff if k == 1 else 1.0) * springs[k] * (b - a) for k, (a, b) in enumerate(itertools.pairwise(angles))
        ]
        discs = {f"disc{k}": (pull[k] - pull[k - 1] - damping[k - 1] * v[f"disc{k}"]) / 0.225 for k in (1, 2, 3)}
        return {**discs, "motor1": 100 * (u.set1 - q.motor1), "motor2": 100 * (u.set2 - q.motor2)}

    names = ("disc1", "disc2", "disc3")
    return Foreign(
        fp.Plant(
            coordinates=dict.fromkeys((*names, "motor1", "motor2"), "rad"),
            inputs={"set1": "rad", "set2": "rad"},
            order={**dict.fromkeys(names, 2), "motor1": 1, "motor2": 1},
            controlled=("motor1", "motor2"),
            response=response,
            parameters=known(stiff=(1.0, 1.2, "1")),
        ),
        {"disc1": 3.0, "disc2": 3.0, "disc3": -4.5},
        fp.Trajectory(
            lambda t: {n: (1.5 * ca.sin(1.2 * t) if n in names else 0 * t) for n in (*names, "motor1", "motor2")}
        ),
        fp.Horizon(stages=20, step=0.1, discretisation=fp.RungeKutta4(8)),
        fp.Quadratic(states=dict.fromkeys(names, 1.0), effort={"set1": 1e-2, "set2": 1e-2}),
        fp.Limits(
            inputs=dict.fromkeys(("set1", "set2"), (-6.3, 6.3)),
            states={"disc1": (-1.4, 6.3), "disc2": (-6.3, 6.3), "disc3": (-6.3, 1.4), "disc2'": (-8.0, 8.0)},
        ),
    )


def cart_pole_on_a_rail() -> Foreign:
    """Swing-up of acados' pendulum on a cart (examples/getting_started: M = 1, m = .1, l = .8, |F| <= 80) on a rail of +-.5 m."""

    def response(q, v, u, p):
        s, c = ca.sin(q.angle), ca.cos(q.angle)
        mass = p.M + p.m - p.m * c**2
        return {
            "x": (-p.m * p.l * s * v.angle**2 + p.m * 9.81 * c * s + u.F) / mass,
            "angle": (-p.m * p.l * c * s * v.angle**2 + u.F * c + (p.M + p.m) * 9.81 * s) / (p.l * mass),
        }

    return Foreign(
        fp.Plant(
            coordinates={"x": "m", "angle": "rad"},
            inputs={"F": "N"},
            controlled=("x",),
            response=response,
            parameters=known(M=(1.0, 1.1, "kg"), m=(0.1, 0.12, "kg"), l=(0.8, 0.75, "m")),
        ),
        {"x": 0.0, "angle": np.pi},
        fp.Trajectory(lambda t: {"x": 0.55 * ca.sin(0.7 * t), "angle": 0 * t}),
        fp.Horizon(stages=40, step=0.05),
        fp.Quadratic(states={"x": 20.0, "angle": 20.0, "x'": 0.1, "angle'": 0.1}, effort={"F": 1e-3}),
        fp.Limits(inputs={"F": (-40.0, 40.0)}, states={"x": (-0.5, 0.5), "x'": (-3.0, 3.0)}),
    )


MACHINES = (van_der_pol, double_integrator, citation, masses, discs, cart_pole_on_a_rail)
