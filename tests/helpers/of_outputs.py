"""Plants whose outputs are expressions of their states: the hand of an arm, and a depth that a Hill curve makes of a level."""

import math
from typing import Any

import casadi as ca

import fpirhc as fp

OPTIMISER = fp.FixedPointSolver(iterations=3, tolerance=1e-2)
ARM = {"l1": 0.5, "l2": 0.4}  # m


def arm(mass: float = 1.0) -> fp.Plant:
    """Two links in a plane, decoupled drives, with the position of the hand as outputs."""

    def response(q: Any, v: Any, u: Any, p: Any) -> dict[str, Any]:
        return {"a": (u.A - 0.2 * v.a) / p.m, "b": (u.B - 0.1 * v.b) / (0.5 * p.m)}

    l1, l2 = ARM["l1"], ARM["l2"]
    return fp.Plant(
        coordinates={"a": "rad", "b": "rad"},
        inputs={"A": "N m", "B": "N m"},
        parameters={"m": fp.Parameter(approximate=1.4, exact=mass, unit="kg m^2")},
        response=response,
        outputs={
            "x": fp.Output("m", lambda q, v, p: l1 * ca.cos(q.a) + l2 * ca.cos(q.a + q.b)),
            "y": fp.Output("m", lambda q, v, p: l1 * ca.sin(q.a) + l2 * ca.sin(q.a + q.b)),
        },
    )


def circle(plant: fp.Plant, radius: float = 0.1, **settings: Any) -> fp.Problem:
    """The hand on a circle, from rest on it."""
    a, b, (l1, l2) = 0.4, 1.1, ARM.values()
    x0, y0 = l1 * math.cos(a) + l2 * math.cos(a + b), l1 * math.sin(a) + l2 * math.sin(a + b)

    def motion(t: Any) -> dict[str, Any]:
        return {
            "x": x0 - radius * (1 - ca.cos(2 * t)),
            "y": y0 + radius * ca.sin(2 * t) - 2 * radius * t * ca.exp(-5 * t),
        }

    moved, start = fp.Trajectory(motion), {"a": a, "b": b}
    return fp.Problem(plant, moved, start, period=2e-3, duration=4.0, measure_from=1.0, **settings)


# A curve from the state to what is measured: two first-order parts and a Hill curve, as the depth of anaesthesia.

E0, STEEP = 93.0, 1.4


def curve(level: Any, half: Any) -> Any:
    return E0 / (1 + (level / half) ** STEEP)


def hill(believed: float) -> fp.Plant:
    """C' = u - C, E' = (C - E) / 2, depth = E0 / (1 + (E / half)^g), with a wrong half."""
    return fp.Plant.of_states(
        states={"C": "mg/l", "E": "mg/l"},
        inputs={"u": "mg/l/min"},
        parameters={"half": fp.Parameter(approximate=believed, exact=4.0, unit="mg/l")},
        rates=lambda x, u, p: {"C": u.u - x.C, "E": 0.5 * (x.C - x.E)},
        outputs={"depth": fp.Output("1", lambda x, p: curve(x.E, p.half))},
        time_unit="min",
    )


def sedated(plant: fp.Plant, **settings: Any) -> fp.Problem:
    """Depth from 74 to 50 and on to 40, smoothly, from rest."""
    first = curve(1.5, 4.0)

    def motion(t: Any) -> dict[str, Any]:
        return {"depth": 50 + (first - 50) * (1 + t / 2) * ca.exp(-t / 2) - 10 / (1 + ca.exp(10 - t))}

    start = {"C": 1.5, "E": 1.5} if plant.outputs else {"depth": first}
    limits = fp.Limits(inputs={"u": (0.0, 40.0)})
    return fp.Problem(
        plant=plant, reference=fp.Trajectory(motion), start=start, period=1 / 60, duration=20.0, measure_from=3.0,
        **{"limits": limits, **settings},
    )  # fmt: skip


def planned(**settings: Any) -> fp.Problem:
    """The depth with a horizon."""
    cost = fp.Quadratic(outputs={"depth": 1.0, "depth'": 0.1}, rate={"u": 1e-3})
    return sedated(hill(5.5), horizon=fp.Horizon(stages=16, step=0.25), **{"cost": cost, **settings})


def affine(gain: float) -> fp.Affine:
    """The affine map with this effective gain."""
    return fp.Affine(gain=-2 * gain)
