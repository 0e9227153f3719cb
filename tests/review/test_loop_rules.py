"""Rules that tell from a few numbers whether the iteration suits its loop: rates, basins, two-cycles, lags and resonances."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from chains import chain, coupled, errors_after_request, linear_loop, linear_pair
from sampled import edge, lag, poles, resonance

import fpirhc as fp
from fpirhc.contraction.delayed import (
    basin_of_plain_form,
    bearable_lag,
    damped_product,
    least_product,
    resonant_limit,
    slowest_iteration,
    step_for_basin,
    two_cycle_amplitudes,
    two_cycle_limit,
)
from fpirhc.controllers.contract import resolved
from fpirhc.deformation import Deformation
from fpirhc.errors import InvalidShape, InvalidValue

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


@pytest.mark.parametrize(
    ("order", "eigenvalue", "rate", "inside"),
    [(2, 1.5, 80.0, 0.85), (2, 1.5, 17.0, 0.85), (2, 1.5, 6.0, 0.85), (3, 1.2, 10.0, 0.85), (1, 1.0, 17.0, 0.7)],
)
def test_basin_ends_between_its_share_and_the_formula(order, eigenvalue, rate, inside):
    """A request that is wrong by so much that |f - d| is a share of the formula: settles below, grows or cycles above it.

    With two poles the threshold is at 0.72, with more between 0.85 and 1.
    """
    sigmoid, problem = fp.Sigmoid(gain=-0.5, scale=2.0), chain(order, eigenvalue)
    basin = basin_of_plain_form(sigmoid.largest_step(), order + 1, rate, PERIOD, eigenvalue=eigenvalue)
    requests = [[share * basin / eigenvalue] for share in (inside, 1.0)]
    errors = errors_after_request(problem, torque(rate, sigmoid), requests, int(60 / (rate * PERIOD)))
    settled, grown = np.abs(errors[-200:, 0]).max(axis=0)
    assert settled < 1e-3 * basin
    assert grown > 0.1 * basin


def test_basin_scales_with_the_map():
    """Twice the scale, twice the basin; the rule for the step is its inverse with a spare factor."""
    basins = [basin_of_plain_form(fp.Sigmoid(gain=-0.5, scale=s).largest_step(), 3, 6.0, PERIOD) for s in (1.0, 2.0)]
    assert basins[1] == pytest.approx(2 * basins[0], rel=1e-12)
    step = step_for_basin(30.0, 3, 6.0, PERIOD)
    assert basin_of_plain_form(step, 3, 6.0, PERIOD) == pytest.approx(1.25 * 30.0, rel=1e-12)
    assert step / fp.Sigmoid(gain=-0.5, scale=1.0).largest_step() == pytest.approx(
        1.55 * least_product(3, 6.0, PERIOD) * 30.0, rel=5e-3
    )
    assert basin_of_plain_form(1.0, 1, 6.0, PERIOD) == math.inf
    for call in (lambda: step_for_basin(-1.0, 3, 6.0, PERIOD), lambda: basin_of_plain_form(0.0, 3, 6.0, PERIOD)):
        with pytest.raises(InvalidValue, match="expected"):
            call()


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


def cycle_limit(problem: fp.Problem, rate: float) -> float:
    low, high = linear_pair(problem, torque(rate, fp.Affine(gain=-1.0)), (0.3, 0.6))
    return two_cycle_limit(low, high, (0.3, 0.6))


def with_secant(share: float, scale: float = 5.0) -> fp.Sigmoid:
    """A sigmoid with that secant gain."""
    sigmoid = fp.Sigmoid(gain=-1.0, scale=scale)
    return sigmoid.with_effective_gain(share * sigmoid.effective_gain() / sigmoid.secant_gain())


@pytest.mark.parametrize("eigenvalue", [1.0, 1.5])
@pytest.mark.parametrize("rate", [6.0, 17.0, 80.0])
def test_two_cycle_limit_counts_the_tracking_law(eigenvalue, rate):
    """Relative order 2: |L(-1)| = (lambda / 2)(1 + 3/2 Lambda T), and not lambda / 2, which the inner iteration alone has."""
    expected = 2 / (eigenvalue * (1 + 1.5 * rate * PERIOD))
    assert cycle_limit(chain(2, eigenvalue), rate) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("problem", "rate"), [(chain(2, 1.5), 6.0), (chain(2, 1.5), 17.0), (coupled(), 6.0)])
def test_two_cycles_begin_at_the_limit(problem, rate):
    """Twelve first requests: all settle at 0.99 of the limit; at 1.01 some end in the cycle of the predicted size."""
    limit, random = cycle_limit(problem, rate), np.random.default_rng(0)
    requests = random.uniform(-10, 10, size=(12, len(problem.plant.names)))
    below, above = (
        errors_after_request(problem, torque(rate, with_secant(share * limit)), requests, 6000)[-50:]
        for share in (0.99, 1.01)
    )
    assert np.abs(below).max() < 1e-9
    sizes = np.linalg.norm(above, axis=1).max(axis=0)
    cycling = sizes > 0.1
    assert 0 < cycling.sum() < 12
    amplitudes = two_cycle_amplitudes(with_secant(1.01 * limit), limit, size=1.0)
    assert len(amplitudes) == 2
    np.testing.assert_allclose(sizes[cycling], amplitudes[1], rtol=1e-6)


def test_no_two_cycle_below_the_limit():
    """No amplitude where the secant is nowhere as steep; one where the linear loop itself is unstable."""
    assert two_cycle_amplitudes(with_secant(0.99), 1.0, size=1.0) == ()
    assert len(two_cycle_amplitudes(fp.Sigmoid(gain=-1.0, scale=1.0).with_effective_gain(1.2), 1.0, size=1.0)) == 1
    assert two_cycle_amplitudes(fp.Affine(gain=-1.0), 1.0, size=1.0) == ()


def test_two_cycle_limit_of_a_gain_of_the_other_sign():
    """A model with the wrong sign and a map with a negative gain make the same loop."""
    low, high = linear_pair(chain(2, 1.5), torque(6.0, fp.Affine(gain=-1.0)), (0.3, 0.6))
    assert two_cycle_limit(low, high, (-0.3, -0.6)) == pytest.approx(two_cycle_limit(low, high, (0.3, 0.6)))
    assert two_cycle_limit(np.eye(2), np.eye(2), (0.3, 0.6)) == math.inf


def test_two_cycles_refuse_bad_input():
    """Matrices that do not match, equal gains, a map with memory, no limit."""
    with pytest.raises(InvalidShape, match="square"):
        two_cycle_limit(np.eye(2), np.eye(3), (0.3, 0.6))
    with pytest.raises(InvalidValue, match="two different"):
        two_cycle_limit(np.eye(2), np.eye(2), (0.3, 0.3))
    with pytest.raises(InvalidValue, match="without memory"):
        two_cycle_amplitudes(fp.Filtered(fp.Affine(gain=-1.0), pole=0.5), 1.0, size=1.0)
    with pytest.raises(InvalidValue, match="limit: expected a number above 0"):
        two_cycle_amplitudes(fp.Affine(gain=-1.0), 0.0, size=1.0)


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


@pytest.mark.parametrize("damping", [0.3, 0.5])
@pytest.mark.parametrize("share", [0.05, 0.1, 0.2])
def test_damped_product_keeps_its_damping(damping, share):
    """Increment form, rate x lag up to 0.2: at the product of the rule the fast pair is damped as asked, to 15 %."""
    tau = 0.02
    rate = share / tau
    gain = damped_product(PERIOD, tau, rate, 3, damping=damping)
    modes = np.log(poles(lag(tau), 2, rate, PERIOD, gain, plain=False).astype(complex)) / PERIOD
    fast = modes[(np.abs(modes) > 1.5 * rate) & (modes.imag > 1.0) & (modes.real > -0.9 / PERIOD)]
    least = (-fast.real / np.abs(fast)).min()
    assert 0.85 * damping < least < 1.1 * damping


@pytest.mark.parametrize("product", [0.05, 0.3, 1.0])
def test_bearable_lag_inverts_the_damped_product(product):
    """At the lag that is returned the rule allows exactly this product; a slow tracking law bears T / (4 zeta^2 g)."""
    longest = bearable_lag(product, PERIOD, 6.0, 3, damping=0.3)
    assert damped_product(PERIOD, longest, 6.0, 3, damping=0.3) == pytest.approx(product, rel=1e-9)
    assert bearable_lag(product, PERIOD, 0.0, 3, damping=0.3) == pytest.approx(PERIOD / 0.36 / product, rel=1e-9)


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


@pytest.mark.parametrize(
    "call",
    [
        lambda: damped_product(PERIOD, 0.01, 1.0, 3, damping=0.0),
        lambda: bearable_lag(0.0, PERIOD, 6.0, 3, damping=0.3),
        lambda: resonant_limit(PERIOD, 6.0, 3, frequency=-1.0, damping=0.1),
    ],
)
def test_lags_and_resonances_refuse_bad_input(call):
    with pytest.raises(InvalidValue, match="expected"):
        call()


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


def test_resonances_bear_the_gain_of_the_rule():
    """Twenty random flexible joints: the edge of the gain within 10 % of the rule where its margin is not small."""
    random, worst = np.random.default_rng(6), 0.0
    for _ in range(20):
        frequency, damping = random.uniform(100, 400), random.uniform(0.05, 0.2)
        rate, eigenvalue = random.uniform(0.005, 0.03) * frequency, random.uniform(0.6, 1.6)
        period = 0.02 / frequency
        rate = min(rate, 0.25 * 2 * damping * frequency / (3 * eigenvalue))
        limit = resonant_limit(period, rate, 3, frequency=frequency, damping=damping, eigenvalue=eigenvalue)

        def stable(gain: float, at=(frequency, damping, rate, eigenvalue, period)) -> bool:
            response = resonance(at[0], at[1], at[3])
            return np.abs(poles(response, 2, at[2], at[4], gain, plain=False)).max() < 1

        worst = max(worst, abs(edge(stable, 0.3 * limit, 3 * limit) / limit - 1))
    assert worst < 0.1
