"""Closed loops of reactors and tanks with limits of states, from textbooks and other tools' examples.

Each is a `Foreign`: the model has parameters that are wrong about the plant, and the reference runs against a limit. Limits that a
source gives are kept; the others are chosen so that plans meet them. Time is in the unit of the source.
"""

from __future__ import annotations

import casadi as ca
from foreign import Foreign, known

import fpirhc as fp


def level_reactor() -> Foreign:
    """Stirred tank with level (J. B. Rawlings, D. Q. Mayne, M. Diehl, Model Predictive Control, 2nd ed. 2017, example 1.11).

    Feed flow .1 m^3/min with 1 kmol/m^3 at 350 K; the wrong model has 10 % less feed. Temperature and level are limited.
    """

    def response(q, u, p):
        rate = 7.2e10 * ca.exp(-8750 / q.T) * q.c  # kmol/(m^3 min)
        area = ca.pi * 0.219**2
        return {
            "c": p.feed * (1 - q.c) / (area * q.h) - rate,
            "T": p.feed * (350 - q.T) / (area * q.h)
            + 5e4 / 239 * rate
            + 2 * 54.94 / (0.219 * 239) * (100 * u.Tc - q.T),
            "h": (p.feed - u.F) / area,
        }

    return Foreign(
        fp.Plant(
            coordinates={"c": "kmol/m^3", "T": "K", "h": "m"},
            inputs={"Tc": "100 K", "F": "m^3/min"},
            controlled=("T", "h"),
            order=1,
            response=response,
            parameters=known(feed=(0.1, 0.11, "m^3/min")),
        ),
        {"c": 0.878, "T": 324.5, "h": 0.659},
        fp.Trajectory(
            lambda t: {"c": 0.878 - 0.03 * ca.sin(0.3 * t), "T": 324.5 + 0 * t, "h": 0.659 + 0.12 * ca.sin(0.35 * t)}
        ),
        fp.Horizon(stages=25, step=0.25, discretisation=fp.RungeKutta4(2)),  # min
        fp.Quadratic(states={"c": 1e3, "h": 50.0}, rate={"Tc": 1.0, "F": 10.0}),
        fp.Limits(inputs={"Tc": (2.9, 3.1), "F": (0.05, 0.15)}, states={"T": (322.5, 326.0), "h": (0.58, 0.74)}),
        before={"Tc": 3.0, "F": 0.1},
    )


def van_de_vusse() -> Foreign:
    """Isothermal van de Vusse reactor (F. J. Doyle, B. A. Ogunnaike, R. K. Pearson, Automatica 31(5), 1995).

    k = 50 1/h, 100 1/h, 10 l/(mol h), feed 10 mol/l; the product B answers to the flow in the wrong direction first, A is limited.
    """

    def response(q, u, p):
        return {
            "A": -p.k1 * q.A - p.k3 * q.A**2 + 10 * u.flow * (10 - q.A),
            "B": p.k1 * q.A - 100 * q.B - 10 * u.flow * q.B,
        }

    return Foreign(
        fp.Plant(
            coordinates={"A": "mol/l", "B": "mol/l"},
            inputs={"flow": "10/h"},
            controlled=("A",),
            order=1,
            response=response,
            parameters=known(k1=(50.0, 55.0, "1/h"), k3=(10.0, 9.0, "l/(mol h)")),
        ),
        {"A": 3.0, "B": 1.117},
        fp.Trajectory(lambda t: {"A": 3.0 + 0 * t, "B": 1.1 + 0.12 * ca.sin(25 * t)}),
        fp.Horizon(stages=30, step=0.002),  # h
        fp.Quadratic(states={"B": 1e4}, rate={"flow": 1e-3}),
        fp.Limits(inputs={"flow": (0.0, 10.0)}, states={"A": (2.6, 3.2), "B": (0.5, 1.5)}),
        before={"flow": 3.43},
    )


def quadruple_tank() -> Foreign:
    """Four tanks and two pumps (K. H. Johansson, IEEE Trans. Control Systems Technology 8(3), 2000), minimum-phase setting.

    The model has the valves' shares of the source, the plant those of valves that are a little further open. Levels are limited.
    """

    def response(q, u, p):
        out = {
            k: area * ca.sqrt(2 * 981 * q[k])
            for k, area in (("h1", 0.071), ("h2", 0.057), ("h3", 0.071), ("h4", 0.057))
        }
        return {
            "h1": (-out["h1"] + out["h3"] + p.share1 * 3.33 * u.v1) / 28,
            "h2": (-out["h2"] + out["h4"] + p.share2 * 3.35 * u.v2) / 32,
            "h3": (-out["h3"] + (1 - p.share2) * 3.35 * u.v2) / 28,
            "h4": (-out["h4"] + (1 - p.share1) * 3.33 * u.v1) / 32,
        }

    return Foreign(
        fp.Plant(
            coordinates=dict.fromkeys(("h1", "h2", "h3", "h4"), "cm"),
            inputs={"v1": "V", "v2": "V"},
            controlled=("h1", "h2"),
            order=1,
            response=response,
            parameters=known(share1=(0.70, 0.73, "1"), share2=(0.60, 0.64, "1")),
        ),
        {"h1": 12.4, "h2": 12.7, "h3": 1.8, "h4": 1.4},
        fp.Trajectory(
            lambda t: {
                "h1": 12.4 + 3 * ca.sin(0.012 * t),
                "h2": 12.7 + 3 * ca.cos(0.015 * t),
                "h3": 1.8 + 0 * t,
                "h4": 1.4 + 0 * t,
            }
        ),
        fp.Horizon(stages=30, step=5.0),  # s
        fp.Quadratic(states={"h1": 1.0, "h2": 1.0}, effort={"v1": 1e-2, "v2": 1e-2}),
        fp.Limits(
            inputs={"v1": (0.0, 6.0), "v2": (0.0, 6.0)},
            states={"h1": (5.0, 14.5), "h2": (5.0, 14.0), "h3": (0.5, 2.4), "h4": (0.5, 1.7)},
        ),
    )


def fed_batch() -> Foreign:
    """Fed-batch bioreactor (do-mpc, examples/batch_reactor; B. Srinivasan et al., Computers and Chemical Engineering 27(1), 2003).

    Biomass is limited to 3.7 g/l and product to 3 g/l as there; biomass and product are asked for faster than the limits let them.
    """

    def response(q, u, p):
        growth = 0.02 * q.S / (0.05 + q.S + q.S**2 / 5) * q.X
        return {
            "X": growth - u.feed / q.V * q.X,
            "S": -growth / p.yield_X - 0.004 * q.X / 1.2 + u.feed / q.V * (p.inlet - q.S),
            "P": 0.004 * q.X - u.feed / q.V * q.P,
            "V": u.feed,
        }

    return Foreign(
        fp.Plant(
            coordinates={"X": "g/l", "S": "g/l", "P": "g/l", "V": "l"},
            inputs={"feed": "l/min"},
            controlled=("S",),
            order=1,
            response=response,
            parameters=known(yield_X=(0.4, 0.44, "1"), inlet=(200.0, 180.0, "g/l")),
        ),
        {"X": 1.0, "S": 0.1, "P": 0.0, "V": 120.0},
        fp.Trajectory(lambda t: {"X": 2.0 + 0.02 * t, "S": 0.1 + 0 * t, "P": 0.0165 * t, "V": 120 + 0 * t}),
        fp.Horizon(stages=20, step=0.5, discretisation=fp.RungeKutta4(2)),  # min
        fp.Quadratic(states={"X": 1.0, "P": 10.0}, rate={"feed": 10.0}),
        fp.Limits(inputs={"feed": (0.0, 0.2)}, states={"X": (0.0, 3.7), "S": (0.0, 0.12), "P": (0.0, 3.0)}),
    )


PROCESSES = (level_reactor, van_de_vusse, quadruple_tank, fed_batch)
