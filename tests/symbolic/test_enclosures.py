"""Bounds of functions over boxes, and Newton's method: against numbers that are known."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from fpirhc.task.reality import Equations

X = ca.SX.sym("x", 3)
a, b, c = ca.vertsplit(X)


# Newton's method with steps of least length: against roots that are known


Z, R = ca.SX.sym("z", 2), ca.SX.sym("r")
CIRCLE = Equations(Z, [R], ca.sumsqr(Z) - R**2)


def test_where_many_points_are_roots_it_goes_to_the_nearest_of_a_circle() -> None:
    """Its steps are along the gradient, which is the ray: from (3, 4) to 2 (3, 4) / 5."""
    root = CIRCLE.root(np.array([3.0, 4.0]), np.array([2.0]))
    assert root is not None
    assert root.at == pytest.approx([1.2, 1.6], abs=1e-12)
    assert root.left < 1e-10 < root.first


def test_equations_of_very_different_sizes_count_alike() -> None:
    """The line x + y = 3 and a million million times x y = 2, from a point that is nearer to (1, 2)."""
    both = Equations(Z, [], ca.vertcat(ca.sum1(Z) - 3, 1e12 * (Z[0] * Z[1] - 2)))
    root = both.root(np.array([0.5, 2.0]))
    assert root is not None
    assert root.at == pytest.approx([1.0, 2.0], abs=1e-12)


def test_a_rest_that_solves_nothing_is_told() -> None:
    """Z = 0 and z = 2 cannot both be; least squares end between them, one from each."""
    valley = Equations(Z[0], [], ca.vertcat(Z[0], Z[0] - 2))
    root = valley.root(np.array([5.0]))
    assert root is not None
    assert root.at == pytest.approx([1.0])
    assert root.left == pytest.approx(1.0)


def test_no_root_and_no_number_are_none() -> None:
    """A circle of an imaginary radius has no point; the logarithm of a negative number is none."""
    imaginary = Equations(Z, [], ca.sumsqr(Z) + 1)
    assert imaginary.root(np.array([3.0, 4.0])) is None
    assert Equations(Z[0], [], ca.log(Z[0]) + 1).root(np.array([-1.0])) is None
