"""Composed Functions in C: every way of taking apart and putting together has the bits of the virtual machine."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from fpirhc.symbolic.native import find_compiler, native

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")
MX = ca.MX
SCALAR = ca.SX.sym("s", 3)
LEAF = ca.Function("fpirhc_leaf", [SCALAR], [ca.sin(SCALAR) + SCALAR[::-1], ca.sumsqr(SCALAR)])


def inner(name: str, times: float) -> ca.Function:
    x, y = MX.sym("x", 3), MX.sym("y", 4)
    first, total = LEAF(times * x)
    return ca.Function(name, [x, y], [ca.vertcat(y[1:3], first), ca.vertcat(total, y)])


def moved(x, y, c):
    """Splits, joins, selections, repetitions and reshapes."""
    a, b = ca.vertsplit(x, [0, 1, 3])
    y = MX(y)
    y[1:3] = b
    table = ca.horzcat(ca.reshape(y, 2, 2), ca.repmat(b, 1, 3))
    return [ca.vertcat(b, a, y[[3, 0, 2]], c), ca.vec(table)[::3], ca.vec(table[:, 1:3]), ca.vertcat(x, y)[1:6]]


def computed(x, y, c):
    """Operations, with one number for all entries, written into each other or read twice."""
    z = ca.vertcat(x, c) * y - 2
    kept = ca.if_else(c > 0, ca.vertcat(x, c), y)
    worst = ca.mmax(ca.fabs(z)) - ca.mmin(z)
    return [kept + z, worst, ca.logic_not(z > 0) / ca.fmax(y * y, 0.1), -z + ca.norm_inf(x), 1 / (3 + ca.fabs(x))]


def called(x, y, c):
    """Calls in one and in several places, and results that nobody reads."""
    once, many = inner("fpirhc_once", 1.0), inner("fpirhc_many", 2.0)
    p, q = once(x, y)
    r, _ = many(p[2:5], q[1:5])
    u, v = many(r[:3], ca.vertcat(c, r[1:4]))
    return [ca.vertcat(u, q), v, LEAF(u[1:4])[1]]


def chosen(x, y, c):
    """Choices of computed, of given and of constant values."""
    yes, no = inner("fpirhc_yes", 3.0), inner("fpirhc_no", 4.0)
    p, q = ca.Function.if_else("fpirhc_choice", yes, no)(c > 0, x, y)
    m = ca.if_else(c > 1, ca.vertcat(y, y), ca.DM(np.arange(8.0)), True)
    return [p, ca.vertcat(q[2:4], m[3:6]), m[4:7] * x, c + ca.if_else(c < 0, c * x[0], 5, True)]


def mapped(x, y, c):
    """Loops over columns, some of them the same for all."""
    table = ca.horzcat(x, 2 * x, x - c)
    s, t = LEAF.map(3)(table)
    same, _ = inner("fpirhc_wide", 1.0).map(2)(ca.repmat(x, 1, 2), ca.horzcat(y, y[::-1]))
    return [s, t, ca.vec(same)]


@needs_compiler
@pytest.mark.parametrize("graph", [moved, computed, called, chosen, mapped])
@pytest.mark.parametrize("number", [2.0, 0.5, -1.0])
def test_c_has_the_bits_of_the_virtual_machine(graph, number):
    symbols = MX.sym("x", 3), MX.sym("y", 4), MX.sym("c")
    function = ca.Function(f"fpirhc_{graph.__name__}", [*symbols], graph(*symbols))
    compiled = native(function, required=True)
    assert compiled.compiled
    values = np.array([0.3, -1.7, 2.0]), np.array([1.0, -0.0, 3.0, 0.5]), number
    for one, other in zip(compiled.function(*values), function(*values), strict=True):
        np.testing.assert_array_equal(one.full(), other.full())


@needs_compiler
def test_every_operation_has_the_bits_of_the_virtual_machine():
    """Of scalar code that is called, with results that nobody reads."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    unary = [ca.exp, ca.log, ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.atanh,
             ca.log1p, ca.expm1, ca.floor, ca.ceil, ca.sqrt, ca.fabs, ca.sign, ca.logic_not, ca.erf]  # fmt: skip
    binary = [ca.fmin, ca.fmax, ca.atan2, ca.hypot, ca.fmod, ca.copysign, ca.logic_or, ca.logic_and]
    values = [*(f(x) for f in unary), ca.acosh(x + 2), *(f(x, y) for f in binary), *(f(y, x) for f in binary)]
    values += [
        x**y,
        x**2.5,
        x * x,
        2 * x,
        1 / x,
        -x,
        x - y,
        x / y,
        x < y,
        x <= y,
        x == y,
        x != y,
        ca.if_else(x > y, x, y),
    ]
    leaf = ca.Function("fpirhc_operations", [x, y], [ca.vertcat(*values), x + y, ca.vertcat(y, x)])
    a, b = MX.sym("a"), MX.sym("b", 2)
    results, _, turned = leaf(a, b[1])
    whole = ca.Function("fpirhc_operations_inside", [a, b], [ca.vertcat(results, turned), turned[0] * 2])
    for first, second in ((0.3, 0.7), (0.9, -0.2), (0.5, 0.5)):
        at = first, np.array([5.0, second])
        for one, other in zip(native(whole, required=True).function(*at), whole(*at), strict=True):
            np.testing.assert_array_equal(one.full(), other.full())
