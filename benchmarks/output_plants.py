"""Plants whose outputs follow references under a wrong model, written by their states: relative orders 1 and 2.

Equations and exact parameters are those of the sources that stand beside them. The errors of the models, the tasks and the weights
are chosen here: a plan has time for a few of the plant's motions, and the exact model follows nearly perfectly, so that an error is
the model's.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
from foreign import known

import fpirhc as fp

SMOOTH = fp.RungeKutta4(4)


def growth() -> fp.Problem:
    """Order 1 of 2. Growth rate of a culture by dilution (G. Bastin, D. Dochain, Adaptive Control of Bioreactors, 1990).

    Monod's rate, with another fastest growth and half saturation in the model.
    """

    def rate(x, p):
        return p.fastest * x.substrate / (p.half + x.substrate)

    plant = fp.Plant.of_states(
        states={"biomass": "g/l", "substrate": "g/l"},
        inputs={"dilution": "1/h"},
        rates=lambda x, u, p: {
            "biomass": (rate(x, p) - u.dilution) * x.biomass,
            "substrate": u.dilution * (20.0 - x.substrate) - rate(x, p) * x.biomass / 0.4,
        },
        outputs={"growth": fp.Output("1/h", rate)},
        parameters=known(fastest=(0.48, 0.6, "1/h"), half=(0.12, 0.25, "g/l")),
        time_unit="h",
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"growth": 0.4 + 0.03 * ca.sin(t)}),
        start={"biomass": 7.8, "substrate": 0.5},
        period=0.02,
        duration=12.0,
        measure_from=4.0,
        limits=fp.Limits(inputs={"dilution": (0.0, 1.5)}),
        horizon=fp.Horizon(stages=15, step=0.1, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"growth": 1.0}, rate={"dilution": 1e-7}),
        input_before={"dilution": 0.4},
    )


def double_tank() -> fp.Problem:
    """Order 2 of 2. The lower of two tanks by the pump above (K. J. Astrom, M. Lundh, IEEE Control Systems 12(2), 1992)."""

    def rates(x, u, p):
        above, below = ca.sqrt(x.upper), ca.sqrt(x.lower)
        return {"upper": p.b * u.pump - p.a * above, "lower": p.a * above - p.a * below}

    plant = fp.Plant.of_states(
        states={"upper": "dm", "lower": "dm"},
        inputs={"pump": "1"},
        rates=rates,
        outputs={"lower": fp.Output("dm", lambda x, p: x.lower)},
        parameters=known(a=(0.5, 0.6, "1"), b=(1.2, 1.0, "dm/min")),
        time_unit="min",
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"lower": 1.5 + 0.4 * ca.sin(0.4 * t)}),
        start={"upper": 1.5, "lower": 1.4},
        period=0.05,
        duration=30.0,
        measure_from=12.0,
        limits=fp.Limits(inputs={"pump": (0.0, 2.0)}),
        horizon=fp.Horizon(stages=15, step=0.2, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"lower": 1.0}, rate={"pump": 1e-4}),
        input_before={"pump": 0.7},
    )


def reactor() -> fp.Problem:
    """Order 2 of 2. Conversion of an exothermic reaction by its jacket (D. E. Seborg et al., Process Dynamics and Control)."""

    def rates(x, u, p):
        k = p.k0 * ca.exp(-8750 / x.T)
        return {"c": 1.0 - x.c - k * x.c, "T": 350 - x.T + p.heat * k * x.c + p.wall * (u.jacket - x.T)}

    plant = fp.Plant.of_states(
        states={"c": "mol/l", "T": "K"},
        inputs={"jacket": "K"},
        rates=rates,
        outputs={"conversion": fp.Output("1", lambda x, p: 1 - x.c)},
        parameters=known(k0=(5.8e10, 7.2e10, "1/min"), heat=(180.0, 209.2, "K l/mol"), wall=(2.3, 2.092, "1/min")),
        time_unit="min",
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"conversion": 0.5 + 0.1 * (1 - ca.cos(1.2 * t))}),
        start={"c": 0.5, "T": 350.0},
        period=0.01,
        duration=8.0,
        measure_from=3.0,
        limits=fp.Limits(inputs={"jacket": (250.0, 350.0)}),
        horizon=fp.Horizon(stages=15, step=0.04, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"conversion": 100.0, "conversion'": 1.0}, rate={"jacket": 1e-5}),
        input_before={"jacket": 300.0},
    )


def leaking_pair() -> fp.Problem:
    """Order 2 of 2. The lower level alone of the shipped `leaking_tanks`: valve and leak are wrong."""
    task = fp.load_problem("leaking_tanks").problem
    plant = fp.Plant.of_states(
        states={"h1": "m", "h2": "m"},
        inputs={"u": "ml/s"},
        rates=task.plant.response,
        outputs={"h2": fp.Output("m", lambda x, p: x.h2)},
        parameters=task.plant.parameters,
    )
    return replace(
        task,
        plant=plant,
        reference=fp.Trajectory(lambda t: {"h2": task.reference.coordinates(t)["h2"]}),
        start={"h1": 0.119, "h2": 0.12},
        disturbances={},
        cost=fp.Quadratic(outputs={"h2": 1e4}, rate={"u": 1e-4}),
        horizon=replace(task.horizon, discretisation=SMOOTH),
        period=0.25,
        input_before={"u": 60.0},
        judged=None,
    )


def anaesthesia() -> fp.Problem:
    """Order 2 of 4. Depth of anaesthesia by propofol, as shipped: the curve from drug to depth is wrong."""
    return fp.load_problem("anaesthesia").problem


def hand() -> fp.Problem:
    """Orders 2, 2 of 4. The hand of an arm in a vertical plane (M. W. Spong, Robot Modeling and Control, ch. 7)."""

    def rates(x, u, p):
        c2, s2 = ca.cos(x.q2), ca.sin(x.q2)
        m11 = p.m1 * 0.25 + p.m2 * (1.25 + c2) + 0.2
        m12, m22 = p.m2 * (0.25 + 0.5 * c2) + 0.1, p.m2 * 0.25 + 0.1
        h = -0.5 * p.m2 * s2
        g2 = 0.5 * p.m2 * 9.81 * ca.cos(x.q1 + x.q2)
        g1 = (0.5 * p.m1 + p.m2) * 9.81 * ca.cos(x.q1) + g2
        f1 = u.T1 - h * x.v2 * (2 * x.v1 + x.v2) - g1 - 0.5 * x.v1
        f2 = u.T2 + h * x.v1**2 - g2 - 0.5 * x.v2
        det = m11 * m22 - m12**2
        return {"q1": x.v1, "q2": x.v2, "v1": (m22 * f1 - m12 * f2) / det, "v2": (m11 * f2 - m12 * f1) / det}

    plant = fp.Plant.of_states(
        states={"q1": "rad", "q2": "rad", "v1": "rad/s", "v2": "rad/s"},
        inputs={"T1": "N m", "T2": "N m"},
        rates=rates,
        outputs={
            "x": fp.Output("m", lambda x, p: p.l1 * ca.cos(x.q1) + ca.cos(x.q1 + x.q2)),
            "y": fp.Output("m", lambda x, p: p.l1 * ca.sin(x.q1) + ca.sin(x.q1 + x.q2)),
        },
        parameters=known(m1=(1.3, 1.0, "kg"), m2=(1.4, 1.0, "kg"), l1=(0.95, 1.0, "m")),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"x": 1.1 + 0.2 * ca.cos(2 * t), "y": 0.6 + 0.2 * ca.sin(2 * t)}),
        start={"q1": -0.35, "q2": 1.7, "v1": 0.0, "v2": 0.0},
        period=0.01,
        duration=6.0,
        measure_from=2.0,
        limits=fp.Limits(inputs={"T1": (-60.0, 60.0), "T2": (-30.0, 30.0)}),
        horizon=fp.Horizon(stages=15, step=0.04, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"x": 100.0, "y": 100.0, "x'": 0.3, "y'": 0.3}, rate={"T1": 1e-5, "T2": 1e-5}),
        input_before={"T1": 15.0, "T2": 2.0},
    )
