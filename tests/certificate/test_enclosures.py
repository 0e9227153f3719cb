"""Bounds of functions over boxes: no value is outside, and the excess is quadratic in the width."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.certificate.enclosures import Box, Enclosure
from fpirhc.errors import NotSupported

X = ca.SX.sym("x", 3)
a, b, c = ca.vertsplit(X)
VALUES = {
    "polynomial": a**3 - 2 * a * b + b**2 * c,
    "quotient": (1 + a * b) / (3 + c**2),
    "circular": ca.sin(a) * ca.cos(b) + ca.tan(0.3 * c),
    "exponential": ca.exp(a) * ca.log(5 + b) + ca.tanh(c),
    "roots": ca.sqrt(4 + a) + (5 + b) ** 1.5 + (4 + a) ** -2 + ca.atan(c),
    "power of two arguments": (4 + a) ** b,
    "sides": ca.fabs(a) + ca.fmax(b, c) - ca.fmin(a, c),
    "cases": ca.if_else(ca.logic_or(a < b, c > 1), ca.sin(a), 2 + b) + ca.sign(b) * c,
    "flow": fp.signed_power(3 + a - 0.5 * b, 0.5),
}


def boxes(radius: float, count: int = 60) -> tuple[np.ndarray, Box]:
    centres = np.random.default_rng(0).uniform(-1.5, 1.5, (3, count))
    return centres, Box(centres - radius, centres + radius)


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize("radius", [0.0, 1e-6, 0.05, 0.4])
def test_no_value_is_outside(name, radius):
    enclosure, (centres, box) = Enclosure(VALUES[name], X), boxes(radius)
    bounds, random = enclosure.over(box), np.random.default_rng(1)
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    for signs in (*corners, *random.uniform(-1, 1, (40, 3))):
        values = enclosure.at(centres + radius * signs[:, None])
        assert (values >= bounds.lower).all()
        assert (values <= bounds.upper).all()


@pytest.mark.parametrize("name", [n for n in VALUES if n not in ("sides", "cases")])
def test_the_excess_is_quadratic_in_the_width(name):
    """Against the range to first order, sum_i |df/dx_i| radius."""
    slopes = Enclosure(ca.jacobian(VALUES[name], X), X)
    excess = []
    for radius in (0.04, 0.02):
        centres, box = boxes(radius)
        linear = radius * np.abs(slopes.at(centres)).sum(axis=0)
        bounds = Enclosure(VALUES[name], X).over(box)
        excess.append((0.5 * (bounds.upper - bounds.lower)[0] - linear).max())
    assert excess[1] < 0.35 * excess[0]


def test_a_difference_of_equal_terms_is_zero():
    """Interval arithmetic gives twice the width here."""
    value = (a + b) * c - (b + a) * c + (a - a)
    bounds = Enclosure(value, X).over(boxes(0.3)[1])
    assert (
        np.abs([bounds.lower, bounds.upper]).max() < 0.7
    )  # the product counts its curved part twice: 2 * 0.6 * 0.3 * 2
    assert np.abs([Enclosure(a - a + 0 * b, X).over(boxes(0.3)[1]).upper]).max() < 1e-12


def test_bounds_are_infinite_where_a_function_is_not_defined():
    bounds = Enclosure(ca.vertcat(1 / a, ca.log(a), ca.sqrt(a)), X).over(Box(-np.ones((3, 1)), np.ones((3, 1))))
    assert np.isinf(bounds.lower).all()
    assert np.isinf(bounds.upper).all()


def test_where_a_function_may_jump_there_are_no_bounds():
    """A derivative does not contain the jump, so a bound by derivatives would be false; where the case is sure there are bounds."""
    values = (ca.sign(a), ca.if_else(a < 0.1, b, c), (a <= 0) * b)
    at_the_jump, beside = (Box(np.full((3, 1), low), np.full((3, 1), low + 0.4)) for low in (-0.2, 0.3))
    for value in values:
        assert np.isinf(Enclosure(value, X).over(at_the_jump).upper).all()
        assert np.isfinite(Enclosure(value, X).over(beside).upper).all()


def test_an_operation_without_a_rule_is_named():
    with pytest.raises(NotSupported, match="operation without a rule"):
        Enclosure(ca.erf(a), X)
