"""Plants whose outputs follow references under a wrong model, written by their states: relative order 4.

See `output_plants` for orders 1 and 2, and for what is chosen here.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
from foreign import known
from output_plants import SMOOTH

import fpirhc as fp


def flexible_joint() -> fp.Problem:
    """Order 4 of 4. The link behind a flexible joint (numbers of S. Raghavan, J. K. Hedrick, Int. J. Control 59(2), 1994)."""

    def rates(x, u, p):
        twist = x.motor - x.link
        return {
            "link": x.v,
            "v": 19.5 * p.stiffness * twist - 3.33 * p.weight * ca.sin(x.link),
            "motor": x.w,
            "w": -48.6 * p.stiffness * twist - 1.25 * x.w + 21.6 * p.gain * u.voltage,
        }

    plant = fp.Plant.of_states(
        states={"link": "rad", "v": "rad/s", "motor": "rad", "w": "rad/s"},
        inputs={"voltage": "V"},
        rates=rates,
        outputs={"link": fp.Output("rad", lambda x, p: x.link)},
        parameters=known(stiffness=(0.85, 1.0, "1"), weight=(1.3, 1.0, "1"), gain=(0.8, 1.0, "1")),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"link": 0.6 * ca.sin(1.5 * t)}),
        start={"link": 0.0, "v": 0.9, "motor": 0.0, "w": 0.9},
        period=5e-3,
        duration=8.0,
        measure_from=3.0,
        limits=fp.Limits(inputs={"voltage": (-10.0, 10.0)}),
        horizon=fp.Horizon(stages=20, step=0.05, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"link": 100.0, "link'": 1.0}, rate={"voltage": 1e-4}),
    )


def two_masses() -> fp.Problem:
    """Order 4 of 4. Two masses and a spring, pushed at the other mass (B. Wie, D. S. Bernstein, JGCD 15(5), 1992)."""

    def rates(x, u, p):
        spring = p.k * (x.q1 - x.q2)
        return {"q1": x.v1, "q2": x.v2, "v1": (u.force - spring) / p.m1, "v2": spring / p.m2}

    plant = fp.Plant.of_states(
        states={"q1": "m", "q2": "m", "v1": "m/s", "v2": "m/s"},
        inputs={"force": "N"},
        rates=rates,
        outputs={"q2": fp.Output("m", lambda x, p: x.q2)},
        parameters=known(k=(1.3, 1.0, "N/m"), m1=(1.0, 1.0, "kg"), m2=(1.15, 1.0, "kg")),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"q2": ca.sin(0.8 * t)}),
        start={"q1": 0.0, "q2": 0.0, "v1": 0.5, "v2": 0.8},
        period=0.02,
        duration=20.0,
        measure_from=8.0,
        limits=fp.Limits(inputs={"force": (-3.0, 3.0)}),
        horizon=fp.Horizon(stages=20, step=0.1, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"q2": 100.0, "q2'": 1.0}, rate={"force": 1e-3}),
    )


def four_tanks() -> fp.Problem:
    """Order 4 of 4. The lowest of four tanks in a row, by a pump (tanks of K. H. Johansson, IEEE TCST 8(3), 2000)."""

    def rates(x, u, p):
        outs = [p.hole * ca.sqrt(2 * 981 * h) for h in (x.h1, x.h2, x.h3, x.h4)]
        ins = [p.k * u.pump, *outs[:3]]
        areas = (28.0, 32.0, 28.0, 32.0)
        return {f"h{i + 1}": (ins[i] - outs[i]) / areas[i] for i in range(4)}

    plant = fp.Plant.of_states(
        states=dict.fromkeys(("h1", "h2", "h3", "h4"), "cm"),
        inputs={"pump": "V"},
        rates=rates,
        outputs={"h4": fp.Output("cm", lambda x, p: x.h4)},
        parameters=known(k=(3.8, 3.33, "cm^3/(V s)"), hole=(0.08, 0.071, "cm^2")),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"h4": 13 - ca.cos(t / 100)}),
        start={"h1": 12.0, "h2": 12.0, "h3": 12.0, "h4": 12.0},
        period=1.0,
        duration=800.0,
        measure_from=320.0,
        limits=fp.Limits(inputs={"pump": (0.0, 10.0)}),
        horizon=fp.Horizon(stages=20, step=8.0, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"h4": 1.0}, rate={"pump": 1e-5}),
        input_before={"pump": 3.3},
    )


def four_tanks_steep() -> fp.Problem:
    """Order 4 of 4. The same with a reference that begins with a slope, for which the pump goes from one limit to the other."""
    return replace(four_tanks(), reference=fp.Trajectory(lambda t: {"h4": 12 + 2 * ca.sin(t / 150)}))


def quadrotor() -> fp.Problem:
    """Orders 4, 4 of 8. The position of a planar quadrotor (R. Tedrake, Underactuated Robotics, ch. 3), with drag.

    Two integrators before the thrust give both outputs the order four, and leave no inner states (A. Isidori, ch. 5).
    """

    def rates(x, u, p):
        return {
            "px": x.vx,
            "pz": x.vz,
            "vx": (-x.thrust * ca.sin(x.tilt) - p.drag * x.vx) / p.m,
            "vz": (x.thrust * ca.cos(x.tilt) - p.drag * x.vz) / p.m - 9.81,
            "tilt": x.w,
            "w": u.torque / p.I,
            "thrust": x.slope,
            "slope": u.bend,
        }

    plant = fp.Plant.of_states(
        states={
            "px": "m",
            "pz": "m",
            "vx": "m/s",
            "vz": "m/s",
            "tilt": "rad",
            "w": "rad/s",
            "thrust": "N",
            "slope": "N/s",
        },
        inputs={"bend": "N/s^2", "torque": "N m"},
        rates=rates,
        outputs={"px": fp.Output("m", lambda x, p: x.px), "pz": fp.Output("m", lambda x, p: x.pz)},
        parameters=known(m=(0.55, 0.486, "kg"), I=(0.0045, 0.00383, "kg m^2"), drag=(0.5, 0.3, "N s/m")),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"px": 1.5 * ca.sin(0.9 * t), "pz": ca.sin(1.3 * t)}),
        start={
            "px": 0.0,
            "pz": 0.0,
            "vx": 1.35,
            "vz": 1.3,
            "tilt": 0.0,
            "w": 0.0,
            "thrust": 0.486 * 9.81,
            "slope": 0.0,
        },
        period=0.01,
        duration=8.0,
        measure_from=3.0,
        limits=fp.Limits(inputs={"bend": (-200.0, 200.0), "torque": (-0.2, 0.2)}),
        horizon=fp.Horizon(stages=20, step=0.1, discretisation=SMOOTH),
        cost=fp.Quadratic(
            outputs={"px": 100.0, "pz": 100.0, "px'": 1.0, "pz'": 1.0}, rate={"bend": 1e-5, "torque": 1.0}
        ),
    )
