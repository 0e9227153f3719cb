"""Integrators: order of convergence, and agreement with methods of scipy that control their error."""

import casadi as ca
import numpy as np
import pytest
from helpers.plants import pendulum
from scipy.integrate import solve_ivp

import fpirhc as fp


def _after(integrator, period, cycles):
    plant = pendulum()
    step, x = integrator.step(plant, period), np.array([1.0, 0.5])
    for _ in range(cycles):
        x = step(x, [0.3], plant.exact, [0.0]).full().ravel()
    return x


def _truth(plant, start, command, time, method="DOP853"):
    def rate(_, x):
        return plant.equations.rate(x, command, plant.exact).full().ravel()

    return solve_ivp(rate, (0.0, time), start, method, rtol=1e-12, atol=1e-13).y[:, -1]


def test_runge_kutta_has_order_four():
    """Halving the step divides the error by 2^4."""
    truth = _truth(pendulum(), [1.0, 0.5], [0.3], 1.0)
    errors = [np.linalg.norm(_after(fp.RungeKutta4(n), 0.1, 10) - truth) for n in (1, 2, 4, 8)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.25, equal_nan=False)


def test_forcing_adds_to_the_response():
    """A forcing w on a free double integrator moves it by w t^2 / 2."""
    plant = pendulum()
    rate = plant.equations.forced_rate
    free, forced = rate([0, 0], [0], plant.exact, [0]), rate([0, 0], [0], plant.exact, [2.5])
    np.testing.assert_allclose((forced - free).full().ravel(), [0.0, 2.5], equal_nan=False)


@pytest.mark.parametrize(("degree", "order"), [(2, 3.0), (3, 5.0)])
def test_methods_have_their_order(degree, order):
    """Halving the step divides the error by 2^order, of collocation at d points 2 d - 1."""
    truth, counts = _truth(pendulum(), [1.0, 0.5], [0.3], 2.0), (1, 2, 4) if degree == 3 else (4, 8, 16)
    methods = [fp.Collocation(n, degree, newton=5) for n in counts]
    errors = [np.linalg.norm(_after(method, 0.5, 4) - truth) for method in methods]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.2, equal_nan=False)


STIFF = fp.Plant(
    coordinates={"slow": "K", "fast": "K"},
    inputs={"u": "K"},
    controlled=("fast",),
    order=1,
    response=lambda q, u, p: {"slow": -q.slow + q.fast, "fast": -p.rate * (q.fast - ca.cos(q.slow) - u.u)},
    parameters={"rate": fp.Parameter(1e5, 1e5, "1/s")},
)


def test_a_stiff_plant_is_sent_to_collocation_which_follows_it():
    """A mode of 1e5 1/s over steps of 50 ms: within 1e-4 of the truth; sub-steps of Runge-Kutta would be 2 500."""
    step, x = fp.Collocation().step(STIFF, 0.05), np.array([0.5, 0.0])
    for _ in range(20):
        x = step(x, [0.1], STIFF.exact, [0.0, 0.0]).full().ravel()
    np.testing.assert_allclose(x, _truth(STIFF, [0.5, 0.0], [0.1], 1.0, "Radau"), atol=1e-4, equal_nan=False)
    reference = fp.Trajectory(lambda t: {"slow": 0.5 + 0 * t, "fast": 1.0 + 0 * t})
    limits = fp.Limits(inputs={"u": (-2.0, 2.0)})
    asked = {
        "duration": 1.0,
        "plant": STIFF,
        "reference": reference,
        "start": {"slow": 0.5, "fast": 0.9},
        "limits": limits,
        "period": 0.05,
    }
    with pytest.raises(fp.FpirhcError, match=r"use Reality\(..., integrator=Collocation\(\)\)"):
        fp.Problem(**asked, reality=fp.Reality(STIFF))
    fp.Problem(**asked, reality=fp.Reality(STIFF), integrator=fp.Collocation())
