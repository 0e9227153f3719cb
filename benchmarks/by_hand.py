"""The closed loop of two_mass, CTC with eq (6), written by hand in Python, for floats and modules like numpy."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import fpirhc as fp

TASK = fp.load_problem("two_mass")
CONTROLLER = TASK.controllers["CTC+FPI (eq 6)"]
PERIOD = TASK.problem.period
MODEL = tuple(one.approximate for one in TASK.problem.plant.parameters.values())
EXACT = tuple(one.exact for one in TASK.problem.plant.parameters.values())
FLOATS = SimpleNamespace(
    sin=math.sin, cos=math.cos, tanh=math.tanh, arctanh=math.atanh, sqrt=math.sqrt, minimum=min, maximum=max
)
_FIXED = math.atanh((-1 + math.sqrt(1 + 8 * math.tanh(0.3) ** 2)) / (4 * math.tanh(0.3)))
# Positions, speeds, integrals, the last request and the response to it: what is wanted in the first cycle is no acceleration.
START = (2.2, 5.4, 0.0, 0.0, -18 * 0.6 / 216, -18 * 0.9 / 216, 0.0, 0.0, 0.0, 0.0)


def cycle_of(m: Any, compiled: Callable[[Any], Any] = lambda function: function) -> Any:
    """Return the function (time, memory, exact parameters) -> (memory, errors), with the functions of a module like numpy."""

    @compiled
    def response(x1: Any, x2: Any, v1: Any, v2: Any, u1: Any, u2: Any, par: Any) -> Any:
        m1, m2, s1, s2, k1, k2, l1, l2, b1, b2, g = par
        d1, d2 = x1 - l1, x2 - x1 - l2
        f1 = k1 * d1 * (d1 * d1 + 1e-12) ** ((s1 - 1) / 2)
        f2 = k2 * d2 * (d2 * d2 + 1e-12) ** ((s2 - 1) / 2)
        return g + (-f1 + f2 - b1 * v1 + u1) / m1, g + (-f2 - b2 * v2 + u2) / m2

    @compiled
    def cycle(t: Any, memory: Any, par: Any) -> Any:
        x1, x2, v1, v2, i1, i2, r1, r2, f1, f2 = memory
        s2, c2, s3, c3 = m.sin(2 * t), m.cos(2 * t), m.sin(3 * t), m.cos(3 * t)
        e1, e2 = 2.2 + 0.3 * s2 - x1, 5.4 + 0.3 * s3 - x2
        w1 = -1.2 * s2 + 216 * i1 + 108 * e1 + 18 * (0.6 * c2 - v1)
        w2 = -2.7 * s3 + 216 * i2 + 108 * e2 + 18 * (0.9 * c3 - v2)
        a1, a2 = f1 - w1, f2 - w2
        size = m.sqrt(a1 * a1 + a2 * a2 + 1e-18)
        grow = (m.arctanh(0.5 * m.tanh(-0.5 * size + _FIXED + 0.3)) - _FIXED) / size
        r1, r2 = r1 + grow * a1, r2 + grow * a2
        g1, g2 = response(x1, x2, v1, v2, 0.0, 0.0, MODEL)
        u1 = m.minimum(300.0, m.maximum(-300.0, (r1 - g1) * MODEL[0]))
        u2 = m.minimum(300.0, m.maximum(-300.0, (r2 - g2) * MODEL[1]))
        h = PERIOD
        a1, a2 = response(x1, x2, v1, v2, u1, u2, par)
        p1, p2 = v1 + h / 2 * a1, v2 + h / 2 * a2
        b1, b2 = response(x1 + h / 2 * v1, x2 + h / 2 * v2, p1, p2, u1, u2, par)
        q1, q2 = v1 + h / 2 * b1, v2 + h / 2 * b2
        c1, c2 = response(x1 + h / 2 * p1, x2 + h / 2 * p2, q1, q2, u1, u2, par)
        z1, z2 = v1 + h * c1, v2 + h * c2
        d1, d2 = response(x1 + h * q1, x2 + h * q2, z1, z2, u1, u2, par)
        x1, x2 = x1 + h / 6 * (v1 + 2 * p1 + 2 * q1 + z1), x2 + h / 6 * (v2 + 2 * p2 + 2 * q2 + z2)
        v1, v2 = v1 + h / 6 * (a1 + 2 * b1 + 2 * c1 + d1), v2 + h / 6 * (a2 + 2 * b2 + 2 * c2 + d2)
        f1, f2 = response(x1, x2, v1, v2, u1, u2, par)
        return (x1, x2, v1, v2, i1 + h * e1, i2 + h * e2, r1, r2, f1, f2), (e1, e2)

    return cycle
