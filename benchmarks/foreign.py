"""Horizons of other people's plants with active limits of states: what an optimiser meets that was not tuned for it.

Each has a model with parameters that are wrong (the plant of the recorded loop has the exact ones), a reference that runs against a
limit, and limits of inputs and states. Sources of models and parameters stand beside them; where a source gives a controller's
limits they are kept, else they are chosen so that a third of the plans has an active limit of a state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp


@dataclass(frozen=True, eq=False)
class Foreign:
    """A horizon: plant, where its loop starts (by state), reference, horizon, cost, limits."""

    plant: fp.Plant
    start: dict[str, float]
    reference: fp.Trajectory
    horizon: fp.Horizon
    cost: fp.Quadratic | fp.CustomCost
    limits: fp.Limits
    before: dict[str, float] = field(default_factory=dict)  # inputs of the stage before
    spread: dict[str, float] = field(default_factory=dict)  # of random first states, where limits do not say it

    def first(self, ocp: Any, state: np.ndarray) -> np.ndarray:
        """The horizon's first state for this state of the plant."""
        before = [self.before.get(i, 0.0) for i in self.plant.inputs]
        return np.asarray(ocp.start(state, before).full()).ravel()


def known(**values: tuple[float, float, str]) -> dict[str, fp.Parameter]:
    """Parameters from (approximate, exact, unit)."""
    return {name: fp.Parameter(*value) for name, value in values.items()}


def quadrotor() -> Foreign:
    """Planar quadrotor with limited tilt and climb rate (model: R. Tedrake, Underactuated Robotics, ch. 3)."""

    def response(q, _, u, p):
        lift = u.left + u.right
        return {
            "x": -lift / p.m * ca.sin(q.tilt),
            "z": lift / p.m * ca.cos(q.tilt) - 9.81,
            "tilt": p.r / p.I * (u.right - u.left),
        }

    return Foreign(
        fp.Plant(
            coordinates={"x": "m", "z": "m", "tilt": "rad"},
            inputs={"left": "N", "right": "N"},
            controlled=("z", "tilt"),
            response=response,
            parameters=known(m=(0.55, 0.486, "kg"), I=(0.0045, 0.00383, "kg m^2"), r=(0.25, 0.25, "m")),
        ),
        {"x": 0.0, "z": 0.0},
        fp.Trajectory(lambda t: {"x": 2 * ca.sin(0.9 * t), "z": ca.sin(1.3 * t), "tilt": 0 * t}),
        fp.Horizon(stages=30, step=0.05),
        fp.Quadratic(
            states={"x": 10.0, "z": 10.0, "tilt": 1.0, "x'": 1.0, "z'": 1.0, "tilt'": 0.1},
            effort={"left": 0.05, "right": 0.05},
        ),
        fp.Limits(
            inputs={"left": (0.0, 6.0), "right": (0.0, 6.0)},
            states={"tilt": (-0.35, 0.35), "z'": (-0.8, 0.8), "x'": (-1.5, 1.5)},
        ),
    )


def arm() -> Foreign:
    """Two-link arm in the vertical plane with limited joints and rates (model: M. W. Spong, Robot Modeling and Control, ch. 7)."""

    def response(q, v, u, p):
        c2, s2 = ca.cos(q.q2), ca.sin(q.q2)
        m11 = p.m1 * 0.25 + p.m2 * (1.25 + c2) + 0.2
        m12, m22 = p.m2 * (0.25 + 0.5 * c2) + 0.1, p.m2 * 0.25 + 0.1
        h = -0.5 * p.m2 * s2
        g2 = 0.5 * p.m2 * 9.81 * ca.cos(q.q1 + q.q2)
        g1 = (0.5 * p.m1 + p.m2) * 9.81 * ca.cos(q.q1) + g2
        f1 = u.T1 - h * v.q2 * (2 * v.q1 + v.q2) - g1 - 0.5 * v.q1
        f2 = u.T2 + h * v.q1**2 - g2 - 0.5 * v.q2
        det = m11 * m22 - m12**2
        return {"q1": (m22 * f1 - m12 * f2) / det, "q2": (m11 * f2 - m12 * f1) / det}

    return Foreign(
        fp.Plant(
            coordinates={"q1": "rad", "q2": "rad"},
            inputs={"T1": "N m", "T2": "N m"},
            response=response,
            parameters=known(m1=(1.2, 1.0, "kg"), m2=(1.3, 1.0, "kg")),
        ),
        {"q1": -0.8, "q2": 0.6},
        fp.Trajectory(lambda t: {"q1": -0.8 + 0.9 * ca.sin(1.6 * t), "q2": 0.6 + 0.9 * ca.sin(2.1 * t)}),
        fp.Horizon(stages=30, step=0.05),
        fp.Quadratic(states={"q1": 100.0, "q2": 100.0, "q1'": 1.0, "q2'": 1.0}, effort={"T1": 1e-3, "T2": 1e-3}),
        fp.Limits(
            inputs={"T1": (-40.0, 40.0), "T2": (-15.0, 15.0)},
            states={"q1": (-1.5, -0.1), "q2": (-0.2, 1.3), "q1'": (-1.2, 1.2), "q2'": (-1.5, 1.5)},
        ),
    )


def reactor() -> Foreign:
    """Unstable reactor at 350 K (M. A. Henson, D. E. Seborg, Nonlinear Process Control, 1997), temperature limited from above."""

    def response(q, u, p):
        k = 7.2e10 * ca.exp(-8750 / q.T) * q.C
        return {"C": 1 - q.C - k, "T": 350 - q.T + p.heat * k + p.wall * (u.Tc - q.T)}

    return Foreign(
        fp.Plant(
            coordinates={"C": "mol/l", "T": "K"},
            inputs={"Tc": "K"},
            controlled=("T",),
            order=1,
            response=response,
            parameters=known(heat=(200.0, 5e4 / 239, "K l/mol"), wall=(2.2, 5e4 / 23900, "1/min")),
        ),
        {"C": 0.5, "T": 350.0},
        fp.Trajectory(lambda t: {"C": 0.5 + 0 * t, "T": 350 + 2.0 * ca.sin(1.5 * t)}),
        fp.Horizon(stages=30, step=0.05),  # min
        fp.Quadratic(states={"T": 1.0, "C": 10.0}, rate={"Tc": 0.1}),
        fp.Limits(inputs={"Tc": (280.0, 320.0)}, states={"T": (340.0, 351.5)}),
        before={"Tc": 300.0},
    )


def tanks() -> Foreign:
    """Three tanks in a row with Torricelli's outflow, DTS200 by Amira: two pumps, limited levels and pump rates."""

    def flow(d):
        return fp.signed_power(d, 0.5)

    def response(q, u, p):
        f13, f32, f20 = p.a1 * flow(q.h1 - q.h3), p.a2 * flow(q.h3 - q.h2), p.a3 * flow(q.h2)
        return {"h1": u.Q1 - f13, "h3": f13 - f32, "h2": u.Q2 + f32 - f20}

    return Foreign(
        fp.Plant(
            coordinates={"h1": "dm", "h3": "dm", "h2": "dm"},
            inputs={"Q1": "dm/min", "Q2": "dm/min"},
            controlled=("h1", "h2"),
            order=1,
            response=response,
            parameters=known(a1=(1.0, 1.2, "1"), a2=(1.1, 1.0, "1"), a3=(1.2, 1.4, "1")),
        ),
        {"h1": 3.0, "h3": 2.2, "h2": 1.5},
        fp.Trajectory(lambda t: {"h1": 3.6 + 0.8 * ca.sin(t), "h3": 2.4 + 0 * t, "h2": 1.6 + 0.5 * ca.cos(1.3 * t)}),
        fp.Horizon(stages=30, step=0.1),
        fp.Quadratic(states={"h1": 10.0, "h2": 10.0}, effort={"Q1": 1e-2, "Q2": 1e-2}),
        fp.Limits(
            inputs={"Q1": (0.0, 4.0), "Q2": (0.0, 4.0)},
            states={"h1": (0.2, 4.0), "h2": (0.2, 1.9), "h3": (0.2, 2.9)},
            rates={"Q1": (-8.0, 8.0), "Q2": (-8.0, 8.0)},
        ),
    )


def bicycle() -> Foreign:
    """Kinematic bicycle (J. Kong et al., IEEE IV 2015) between the borders of its lane, at limited speed and steering."""

    def response(q, u, p):
        slip = ca.atan(0.5 * ca.tan(u.steer))
        return {
            "x": q.v * ca.cos(q.psi + slip),
            "y": q.v * ca.sin(q.psi + slip),
            "psi": q.v / p.l * ca.sin(slip),
            "v": u.a - p.c * q.v,
        }

    return Foreign(
        fp.Plant(
            coordinates={"x": "m", "y": "m", "psi": "rad", "v": "m/s"},
            inputs={"steer": "rad", "a": "m/s^2"},
            controlled=("psi", "v"),
            order=1,
            response=response,
            parameters=known(l=(1.5, 1.7, "m"), c=(0.0, 0.05, "1/s")),
        ),
        {"x": 0.0, "y": 0.0, "psi": 0.0, "v": 8.0},
        fp.Trajectory(lambda t: {"x": 9 * t, "y": 1.8 * ca.sin(0.9 * t), "psi": 0 * t, "v": 9 + 0 * t}),
        fp.Horizon(stages=30, step=0.1),
        fp.Quadratic(states={"x": 1.0, "y": 5.0, "psi": 1.0, "v": 0.1}, effort={"steer": 1.0, "a": 0.1}),
        fp.Limits(
            inputs={"steer": (-0.5, 0.5), "a": (-4.0, 3.0)},
            states={"y": (-1.5, 1.5), "v": (0.0, 10.0), "psi": (-0.25, 0.25)},
        ),
    )


def body() -> Foreign:
    """Rigid body by Euler's equations with limited rates, slewed (B. Wie, Space Vehicle Dynamics and Control, ch. 7)."""

    def response(q, u, p):
        return {
            "w1": ((p.I2 - p.I3) * q.w2 * q.w3 + u.T1) / p.I1,
            "w2": ((p.I3 - p.I1) * q.w3 * q.w1 + u.T2) / p.I2,
            "w3": ((p.I1 - p.I2) * q.w1 * q.w2 + u.T3) / p.I3,
        }

    return Foreign(
        fp.Plant(
            coordinates={"w1": "rad/s", "w2": "rad/s", "w3": "rad/s"},
            inputs={"T1": "N m", "T2": "N m", "T3": "N m"},
            order=1,
            response=response,
            parameters=known(I1=(1.2, 1.0, "kg m^2"), I2=(1.8, 2.0, "kg m^2"), I3=(3.2, 3.0, "kg m^2")),
        ),
        {"w1": 0.5, "w2": -0.3, "w3": 0.4},
        fp.Trajectory(lambda t: {"w1": 0.8 * ca.sin(t), "w2": 0.8 * ca.cos(1.2 * t), "w3": 0.6 * ca.sin(0.7 * t)}),
        fp.Horizon(stages=30, step=0.1),
        fp.CustomCost(
            terms=lambda v: {
                "error": sum((10 * (v.state[k] - v.reference[k]) ** 2 for k in ("w1", "w2", "w3")), start=ca.SX(0)),
                "effort": sum(
                    (0.01 * v.input[k] ** 2 + 0.01 * v.input[k] ** 4 for k in ("T1", "T2", "T3")), start=ca.SX(0)
                ),
            },
            terminal=lambda v: sum(
                (10 * (v.state[k] - v.reference[k]) ** 2 for k in ("w1", "w2", "w3")), start=ca.SX(0)
            ),
        ),
        fp.Limits(
            inputs=dict.fromkeys(("T1", "T2", "T3"), (-2.0, 2.0)),
            states={"w1": (-0.6, 0.6), "w2": (-0.6, 0.6), "w3": (-0.45, 0.45)},
        ),
    )


def crane() -> Foreign:
    """Overhead crane with limited sway (Y. Fang et al., IEEE/ASME Trans. Mechatronics 8(3), 2003)."""

    def response(q, v, u, p):
        s, c = ca.sin(q.sway), ca.cos(q.sway)
        x = (u.F - p.b * v.x + p.m * s * (p.l * v.sway**2 + 9.81 * c)) / (p.M + p.m * s**2)
        return {"x": x, "sway": -(x * c + 9.81 * s) / p.l}

    return Foreign(
        fp.Plant(
            coordinates={"x": "m", "sway": "rad"},
            inputs={"F": "N"},
            controlled=("x",),
            response=response,
            parameters=known(M=(6.0, 5.0, "kg"), m=(1.2, 1.0, "kg"), l=(0.8, 0.75, "m"), b=(0.0, 2.0, "N s/m")),
        ),
        {"x": 0.0},
        fp.Trajectory(lambda t: {"x": 0.8 * ca.tanh(4 * ca.sin(0.6 * t)), "sway": 0 * t}),
        fp.Horizon(stages=40, step=0.05),
        fp.Quadratic(states={"x": 20.0, "x'": 1.0, "sway": 5.0, "sway'": 0.5}, effort={"F": 1e-3}),
        fp.Limits(inputs={"F": (-20.0, 20.0)}, states={"sway": (-0.12, 0.12), "x'": (-0.6, 0.6)}),
    )


def pendulum() -> Foreign:
    """Inverted pendulum on a short track (K. J. Astrom, K. Furuta, Automatica 36(2), 2000), disturbed in its upright position."""

    def response(q, v, u, p):
        s, c = ca.sin(q.angle), ca.cos(q.angle)
        x = (u.F - p.m * p.l * s * v.angle**2 + p.m * 9.81 * s * c) / (p.M + p.m * s**2)
        return {"x": x, "angle": (9.81 * s + x * c) / p.l}

    return Foreign(
        fp.Plant(
            coordinates={"x": "m", "angle": "rad"},
            inputs={"F": "N"},
            controlled=("x",),
            response=response,
            parameters=known(M=(1.2, 1.0, "kg"), m=(0.12, 0.1, "kg"), l=(0.5, 0.5, "m")),
        ),
        {"x": 0.0, "angle": 0.05},
        fp.Trajectory(lambda t: {"x": 0.4 * ca.sin(1.2 * t), "angle": 0 * t}),
        fp.Horizon(stages=40, step=0.05),
        fp.Quadratic(states={"x": 20.0, "angle": 10.0, "x'": 1.0, "angle'": 1.0}, effort={"F": 1e-2}),
        fp.Limits(inputs={"F": (-15.0, 15.0)}, states={"x": (-0.32, 0.32), "x'": (-0.7, 0.7)}),
    )


def stirred() -> Foreign:
    """Stirred tank of Klatt and Engell as in the do-mpc examples (LGPL; constants re-typed): flow and cooling, hot limit."""

    def response(q, u, p):
        kelvin = q.TR + 273.15
        k1 = p.b * 1.287e12 * ca.exp(-9758.3 / kelvin)
        k3 = p.a * 9.043e9 * ca.exp(-8560.0 / kelvin)
        rate1, rate2, rate3 = k1 * q.CA, k1 * q.CB, k3 * q.CA**2
        heat = 4.2 * rate1 - 11.0 * rate2 - 41.85 * rate3
        wall = 4032.0 * 0.215
        return {
            "CA": u.F * (5.1 - q.CA) - rate1 - rate3,
            "CB": -u.F * q.CB + rate1 - rate2,
            "TR": u.F * (130.0 - q.TR) + wall * (q.TK - q.TR) / (0.9342 * 3.01 * 10.01) - heat / (0.9342 * 3.01),
            "TK": (-1000 * u.Q + wall * (q.TR - q.TK)) / (5.0 * 2.0),
        }

    return Foreign(
        fp.Plant(
            coordinates={"CA": "mol/l", "CB": "mol/l", "TR": "C", "TK": "C"},
            inputs={"F": "1/h", "Q": "MJ/h"},
            controlled=("CB", "TR"),
            order=1,
            response=response,
            parameters=known(a=(1.0, 1.05, "1"), b=(1.0, 0.95, "1")),
        ),
        {"CA": 1.2, "CB": 0.7, "TR": 134.0, "TK": 130.0},
        fp.Trajectory(
            lambda t: {"CA": 1.3 + 0 * t, "CB": 0.75 + 0.12 * ca.sin(12 * t), "TR": 134 + 0 * t, "TK": 130 + 0 * t}
        ),
        fp.Horizon(stages=20, step=0.005, discretisation=fp.RungeKutta4(2)),
        fp.Quadratic(states={"CB": 100.0, "TR": 1e-3}, rate={"F": 1e-3, "Q": 1e-2}),
        fp.Limits(
            inputs={"F": (5.0, 100.0), "Q": (0.0, 8.5)},
            states={"CA": (0.1, 2.0), "CB": (0.1, 2.0), "TR": (50.0, 136.0), "TK": (50.0, 140.0)},
        ),
        before={"F": 18.8, "Q": 4.5},
        spread={"CA": 0.3, "CB": 0.1, "TR": 3.0, "TK": 3.0},
    )


def servo() -> Foreign:
    """Position servo with a flexible shaft whose torque is limited (A. Bemporad, E. Mosca, Automatica 34(4), 1998)."""

    def response(q, v, u, p):
        twist = 1280.2 * (q.load - q.motor / 20)
        return {
            "load": (-twist - p.bl * v.load) / p.Jl,
            "motor": (twist / 20 - (0.1 + 10**2 / 20) * v.motor + 10 / 20 * u.V) / 0.5,
        }

    torque = fp.PathConstraint(lambda v: 1280.2 * (v.state.load - v.state.motor / 20), -78.5, 78.5, "N m")
    return Foreign(
        fp.Plant(
            coordinates={"load": "rad", "motor": "rad"},
            inputs={"V": "V"},
            controlled=("motor",),
            response=response,
            parameters=known(Jl=(25.0, 20.0, "kg m^2"), bl=(20.0, 25.0, "N m s")),
        ),
        {"load": 0.0},
        fp.Trajectory(
            lambda t: {"load": 0.5 * ca.tanh(5 * ca.sin(0.5 * t)), "motor": 10 * ca.tanh(5 * ca.sin(0.5 * t))}
        ),
        fp.Horizon(stages=30, step=0.1, discretisation=fp.RungeKutta4(4)),
        fp.Quadratic(states={"load": 1e3, "load'": 10.0}, effort={"V": 1e-4}),
        fp.Limits(inputs={"V": (-220.0, 220.0)}, paths={"shaft": torque}),
        spread={"load": 0.02, "motor": 0.2, "load'": 0.05, "motor'": 1.0},
    )


def rocket() -> Foreign:
    """Planar rocket on its way down, with limited tilt, sink rate and gimbal (B. Acikmese, S. Ploen, JGCD 30(5), 2007)."""

    def response(q, _, u, p):
        angle = q.tilt + u.gimbal
        return {
            "x": -p.T * u.throttle * ca.sin(angle),
            "z": p.T * u.throttle * ca.cos(angle) - 9.81,
            "tilt": -p.arm * p.T * u.throttle * ca.sin(u.gimbal),
        }

    return Foreign(
        fp.Plant(
            coordinates={"x": "m", "z": "m", "tilt": "rad"},
            inputs={"throttle": "1", "gimbal": "rad"},
            controlled=("z", "tilt"),
            response=response,
            inverse=lambda q, v, r, p: {"throttle": 0 * r.z, "gimbal": 0 * r.z},
            parameters=known(T=(18.0, 20.0, "m/s^2"), arm=(0.35, 0.3, "1/m")),
        ),
        {"x": 20.0, "z": 60.0, "z'": -6.0},
        fp.Trajectory(lambda t: {"x": 0 * t, "z": 30 * ca.exp(-0.1 * t), "tilt": 0 * t}),
        fp.Horizon(stages=40, step=0.1),
        fp.Quadratic(
            states={"x": 0.2, "z": 0.2, "x'": 0.3, "z'": 0.3, "tilt": 5.0, "tilt'": 5.0},
            effort={"throttle": 1.0, "gimbal": 20.0},
        ),
        fp.Limits(
            inputs={"throttle": (0.2, 1.0), "gimbal": (-0.2, 0.2)},
            states={"tilt": (-0.15, 0.15), "z'": (-7.0, 7.0), "tilt'": (-0.2, 0.2)},
        ),
    )


def double_tank() -> Foreign:
    """Two tanks, one above the other, one pump (K. J. Astrom, M. Lundh, IEEE Control Systems 12(2), 1992), limited pump rate."""

    def response(q, u, p):
        above, below = fp.signed_power(q.upper, 0.5), fp.signed_power(q.lower, 0.5)
        return {"upper": p.b * u.pump - p.a * above, "lower": p.a * above - p.a * below}

    return Foreign(
        fp.Plant(
            coordinates={"upper": "dm", "lower": "dm"},
            inputs={"pump": "1"},
            controlled=("upper",),
            order=1,
            response=response,
            parameters=known(a=(0.5, 0.6, "1"), b=(1.2, 1.0, "dm/min")),
        ),
        {"upper": 1.0, "lower": 1.0},
        fp.Trajectory(lambda t: {"upper": 1.5 + 0 * t, "lower": 1.5 + 0.9 * ca.sin(0.5 * t)}),
        fp.Horizon(stages=40, step=0.2),
        fp.Quadratic(states={"lower": 10.0}, effort={"pump": 1e-2}),
        fp.Limits(
            inputs={"pump": (0.0, 2.0)}, states={"upper": (0.1, 2.0), "lower": (0.1, 2.2)}, rates={"pump": (-1.0, 1.0)}
        ),
    )


def chain() -> Foreign:
    """The shipped chain of three masses (acados' benchmark) in front of a wall, which its end would swing through."""
    problem = fp.load_problem("chain_of_masses").problem
    assert problem.horizon is not None
    assert isinstance(problem.cost, fp.Quadratic)
    wall = dict.fromkeys(("y1", "ye"), (-0.01, np.inf))
    limits = fp.Limits(inputs=problem.limits.inputs, states=wall)
    return Foreign(
        problem.plant,
        dict(problem.start),
        problem.reference,
        problem.horizon,
        problem.cost,
        limits,
        spread=dict.fromkeys(problem.start, 0.1),
    )


PLANTS = (quadrotor, arm, reactor, tanks, bicycle, body, crane, pendulum, stirred, servo, rocket, double_tank, chain)
FOREIGN: dict[str, Callable[[], Foreign]] = {f.__name__: f for f in PLANTS}


def first_states(case: Foreign, count: int, seed: int) -> np.ndarray:
    """Random states (nx, count) around the start, inside their limits."""
    names = case.plant.state.elements
    lower, upper = case.limits.state_bounds(case.plant)
    about = np.array([case.start.get(e, 0.0) for e in names])
    low = np.where(np.isfinite(lower), lower, about - 0.3 * (1 + np.abs(about)))
    high = np.where(np.isfinite(upper), upper, about + 0.3 * (1 + np.abs(about)))
    half = np.array([case.spread.get(e, h) for e, h in zip(names, 0.5 * (high - low), strict=True)])
    random = np.random.default_rng(seed).uniform(-0.6, 0.6, (count, len(names)))
    return np.clip(about + half * random, low + 0.02 * half, high - 0.02 * half).T
