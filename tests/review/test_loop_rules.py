"""Rules that tell from a few numbers whether the iteration suits its loop: rates, basins, two-cycles, lags and resonances."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from chains import chain, linear_loop
from sampled import edge, lag, poles

import fpirhc as fp
from fpirhc.contraction.delayed import least_product, slowest_iteration
from fpirhc.controllers.contract import resolved
from fpirhc.deformation import Deformation
from fpirhc.errors import InvalidValue

PERIOD = 1e-3  # s


def torque(rate: float, deformation: Deformation) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=rate), deformation)


# The low-pass of the plain form


@pytest.mark.parametrize(("order", "published"), [(1, 0.5), (2, 1.125), (3, 1.76), (4, 2.39)])
def test_plain_form_needs_a_fast_iteration(order, published):
    """The edge of the library's own sampled loop, rate x period = 0.002, within 1 % of the closed form."""
    rate, problem = 2.0, chain(order)
    assert slowest_iteration(order + 1) == pytest.approx(published, rel=0.005)

    def stable(product: float) -> bool:
        return linear_loop(problem, torque(rate, fp.Affine(gain=-2 * product))).radius < 1

    limit = least_product(order + 1, rate, PERIOD)
    assert [stable(share * limit) for share in (0.5, 0.99, 1.01, 2.0)] == [False, False, True, True]


def test_increment_form_has_no_slowest_iteration():
    """A hundredth of what the plain form needs is stable in the increment form, and not in the plain one."""
    small = fp.Affine(gain=-2 * 0.01 * least_product(3, 6.0, PERIOD))
    assert linear_loop(chain(), torque(6.0, fp.Increment(small, cycles=0))).radius < 1
    assert linear_loop(chain(), torque(6.0, small)).radius > 1


def test_slowest_iteration_solves_its_polynomial():
    """At the limit two roots of s^(N+1) + w (s + 1)^N are imaginary and none is to the right."""
    for count in range(2, 8):
        polynomial = np.polyadd(
            np.append(1.0, np.zeros(count + 1)), slowest_iteration(count) * np.poly(-np.ones(count))
        )
        real = np.sort(np.roots(polynomial).real)
        assert np.abs(real[-2:]).max() < 1e-6
        assert real[-3] < -1e-3
    assert slowest_iteration(1) == 0


@pytest.mark.parametrize("arguments", [(0, 6.0, PERIOD), (3, -1.0, PERIOD), (3, 6.0, 0.0)])
def test_least_product_refuses_what_is_no_loop(arguments):
    with pytest.raises(InvalidValue, match="expected"):
        least_product(*arguments)


# The basin of the plain form


def test_automatic_scale_covers_the_basin():
    """A load that the model takes for half of what it is, at rest: the reference's slew asks for S = 1, which diverges."""
    plant = fp.Plant(
        coordinates={"q": "m"},
        inputs={"u": "N"},
        parameters={"load": fp.Parameter(approximate=100.0, exact=200.0, unit="N")},
        response=lambda q, v, u, p: {"q": u.u - p.load},
    )
    still = fp.Trajectory(lambda t: {"q": 0 * t})
    problem = fp.Problem(plant, still, start={"q": 0.0}, period=PERIOD, duration=2.0, measure_from=1.5)
    resolved_controller: Any = resolved(problem, torque(80.0, fp.Sigmoid(gain=-0.5)))
    assert resolved_controller.deformation.scale == pytest.approx(
        1.55 * least_product(3, 80.0, PERIOD) * 100.0, rel=0.01
    )
    settled, grown = (
        fp.simulate(problem, torque(80.0, fp.Sigmoid(gain=-0.5, scale=scale)), seed=0, compiled=False)
        for scale in (None, 1.0)
    )
    assert np.abs(settled["error.q"][-100:]).max() < 1e-6
    assert np.abs(grown["error.q"][-100:]).max() > 1e-2


# Two-cycles


# A lag between request and response


@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 3.0])
def test_inner_iteration_behind_a_lag(ratio):
    """The edge of z^2 - (1 + rho - g (1 - rho)) z + rho is 2 coth(T / (2 tau)), 40.03 to 2.21."""
    left = math.exp(-ratio)

    def stable(product: float) -> bool:
        return np.abs(np.roots([1, -(1 + left - product * (1 - left)), left])).max() < 1

    limit = 2 / math.tanh(ratio / 2)
    assert edge(stable, 0.5 * limit, 2 * limit) == pytest.approx(limit, rel=1e-6)


@pytest.mark.parametrize("order", [1, 2, 4])
@pytest.mark.parametrize("plain", [True, False])
def test_fast_iterations_bear_a_lag_up_to_one_over_its_poles(order, plain):
    """T = 1 ms, tau = 20 ms, gain 1: the largest rate x lag is 1 / (n + 1) within 3 %, in both forms."""
    tau = 0.02
    limit = 1 / ((order + 1) * tau)

    def stable(rate: float) -> bool:
        return np.abs(poles(lag(tau), order, rate, PERIOD, 1.0, plain=plain)).max() < 1

    assert edge(stable, 0.5 * limit, 2 * limit) == pytest.approx(limit, rel=0.03)


def test_pairing_through_the_lag():
    """1000 random loops: (z - 1 + a)(z - rho) + a (1 - rho)(lambda - 1) z is stable exactly below the closed form."""
    random = np.random.default_rng(5)
    for _ in range(1000):
        gain, eigenvalue = random.uniform(0.02, 1.98), random.uniform(0.05, 12.0)
        tau = random.uniform(0.1, 10.0)
        left = math.exp(-1 / tau)
        limit = 1 + (2 - gain) * (1 + left) / (gain * (1 - left))
        if abs(eigenvalue / limit - 1) < 1e-9:
            continue
        polynomial = np.polyadd(np.poly([1 - gain, left]), [gain * (1 - left) * (eigenvalue - 1), 0.0])
        assert (np.abs(np.roots(polynomial)).max() < 1) == (eigenvalue < limit)


def test_the_condition_of_a_pairing_is_sufficient():
    """2000 random plants and models, each a lag and a dead time: none with a margin above 1 has a root outside the unit circle."""
    random, sure, stable = np.random.default_rng(8), 0, 0
    angles = np.linspace(0, math.pi, 400)
    z = np.exp(1j * angles)
    for _ in range(2000):
        gain, eigenvalue = random.uniform(0.02, 1.5), random.uniform(0.3, 2.5)
        left, believed = (math.exp(-1 / random.uniform(0.2, 10.0)) for _ in range(2))
        late, expected = (int(v) for v in random.integers(0, 6, size=2))
        plant = eigenvalue * (1 - left) / (z - left) / z**late
        model = (1 - believed) / (z - believed) / z**expected
        # By Rouche's theorem |G - G^| < |1 - (1 - a) / z| / a on the circle suffices.
        margin = (np.abs(1 - (1 - gain) / z) / gain / np.abs(plant - model)).min()
        # (z - 1 + a)(z - l)(z - b) z^m + a z (lambda (1 - l)(z - b) z^(m-late) - (1 - b)(z - l) z^(m-expected)) = 0
        most = max(late, expected)
        polynomial = np.polymul(np.poly([1 - gain, left, believed]), np.eye(most + 1)[0])
        added = np.polysub(
            np.polymul(eigenvalue * (1 - left) * np.poly([believed]), np.eye(most - late + 1)[0]),
            np.polymul((1 - believed) * np.poly([left]), np.eye(most - expected + 1)[0]),
        )
        converges = np.abs(np.roots(np.polyadd(polynomial, np.polymul([gain, 0.0], added)))).max() < 1
        assert converges or margin <= 1
        sure, stable = sure + (margin > 1), stable + converges
    assert 0.6 * stable < sure <= stable


# A resonance between request and response
