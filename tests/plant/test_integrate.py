"""Integrators: order of convergence, and agreement with CVODES."""

from __future__ import annotations

import numpy as np
import pytest
from plants import pendulum

import fpirhc as fp
from fpirhc.errors import InvalidValue


def _after(integrator, period, cycles):
    plant = pendulum()
    step = integrator.step(plant, period)
    x = np.array([1.0, 0.5])
    for _ in range(cycles):
        x = step(x, [0.3], plant.exact, [0.0]).full().ravel()
    return x


def test_runge_kutta_has_order_four():
    """Halving the step divides the error by 2^4; CVODES is the reference."""
    truth = _after(fp.Cvodes(1e-12), 0.1, 10)
    errors = [np.linalg.norm(_after(fp.RungeKutta4(n), 0.1, 10) - truth) for n in (1, 2, 4, 8)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.25, equal_nan=False)


def test_runge_kutta_agrees_with_cvodes():
    """At the control period both integrators give the same motion."""
    fine, truth = _after(fp.RungeKutta4(4), 0.01, 100), _after(fp.Cvodes(1e-12), 0.01, 100)
    np.testing.assert_allclose(fine, truth, rtol=1e-8, equal_nan=False)


@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_cvodes_keeps_its_tolerance_in_every_unit(unit):
    """A spring of rate 1: cos t of where it was let go."""
    spring = fp.Plant({"y": "m"}, {"u": "N"}, {}, lambda q, v, u, p: {"y": u.u - q.y})
    after = fp.Cvodes().step(spring, 1.0)([unit, 0.0], [0.0], [], [0.0])
    np.testing.assert_allclose(after.full().ravel() / unit, [np.cos(1), -np.sin(1)], rtol=1e-8)


def test_forcing_adds_to_the_response():
    """A forcing w on a free double integrator moves it by w t^2 / 2."""
    plant = pendulum()
    rate = plant.equations.forced_rate
    free, forced = rate([0, 0], [0], plant.exact, [0]), rate([0, 0], [0], plant.exact, [2.5])
    np.testing.assert_allclose((forced - free).full().ravel(), [0.0, 2.5], equal_nan=False)


@pytest.mark.parametrize(("method", "order"), [(fp.Euler, 1.0)])
def test_methods_have_their_order(method, order):
    """Halving the step divides the error by 2^order; CVODES is the reference."""
    truth = _after(fp.Cvodes(1e-12), 0.1, 10)
    errors = [np.linalg.norm(_after(method(n), 0.1, 10) - truth) for n in (2, 4, 8, 16)]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.2, equal_nan=False)


@pytest.mark.parametrize("method", [fp.Euler, fp.RungeKutta4])
def test_counts_are_checked(method):
    with pytest.raises(InvalidValue, match="expected a whole number from 1 to"):
        method(0)
    assert method(3).finer(2) == method(6)
    assert method(600).finer(2) is None  # beyond what there may be
