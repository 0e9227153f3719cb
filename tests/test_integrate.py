"""Integrators: order of convergence, and agreement with CVODES."""

from __future__ import annotations

import numpy as np
from plants import pendulum

import fpirhc as fp


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


def test_forcing_adds_to_the_response():
    """A forcing w on a free double integrator moves it by w t^2 / 2."""
    plant = pendulum()
    rate = plant.forced_derivative_function
    free, forced = rate([0, 0], [0], plant.exact, [0]), rate([0, 0], [0], plant.exact, [2.5])
    np.testing.assert_allclose((forced - free).full().ravel(), [0.0, 2.5], equal_nan=False)
