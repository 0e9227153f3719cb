"""A tuner finds its gain on line, follows jumps of the plant's, and survives noise; a denoiser in place of a low-pass."""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.iteration import Scalar
from helpers.kinds import slow_but
from scipy.special import betainc

import fpirhc as fp
from fpirhc.errors import InvalidValue

CYCLES = 4500
SMOOTH = np.sin(0.01 * np.arange(CYCLES))


def run(deformation, gains, noise=None):
    """True response errors of the scalar loop f = gain r along a slow wave."""
    step, request, errors = Scalar(deformation), 0.0, []
    for k in range(1, CYCLES):
        response = gains[k] * request
        errors.append(response - SMOOTH[k])
        request = step(request, response + (0.0 if noise is None else noise[k]), SMOOTH[k])
    return np.array(errors)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_tuner_follows_a_plant_whose_gain_jumps(noise):
    """1.2 -> 15 -> 0.3: the rms response error stays below 0.14 in each regime; a fixed gain cycles in the second."""
    gains = np.repeat([1.2, 15.0, 0.3], CYCLES // 3)
    white = noise * np.random.default_rng(0).standard_normal(CYCLES)
    sigmoid = fp.Sigmoid(gain=-0.5, scale=10.0)
    tuned = fp.Tuned(sigmoid, largest_gain=1.69 * sigmoid.slope)
    results = {}
    for deformation in (sigmoid, tuned):
        errors = run(deformation, gains, white)
        results[deformation] = [np.sqrt(np.mean(part[500:] ** 2)) for part in np.split(errors[: CYCLES - 3], 3)]
    assert max(results[tuned]) < 0.14
    assert results[sigmoid][1] > 10


def test_tuner_forgets_what_is_no_number():
    step = Scalar(fp.Tuned(fp.Affine(gain=-0.5), largest_gain=0.8))
    for response in (1.0, np.nan, 1.0, 1.0, 1.0):
        step(0.0, response, 0.5)
    assert np.isfinite(step.memory.full()).all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"largest_gain": 0.1}, "sector_limit gives one"),
        ({"largest_gain": np.nan}, "expected a number, got nan"),
        ({"largest_gain": 0.8, "target": 2.0}, "product of gain and plant between 0 and 2"),  # it oscillates for ever
    ],
)
def test_tuner_needs_a_bound_and_a_target_that_converges(settings, words):
    with pytest.raises(InvalidValue, match=words):
        fp.Tuned(fp.Affine(gain=-0.5), **settings)


def in_noise(tuned, components, count, seed):
    """Factors of the tuner whose errors are white noise alone."""
    return factors_of(tuned, np.random.default_rng(seed).standard_normal((components, count)))


def factors_of(tuned, noise):
    """Factors of the tuner, after every step, where the response is the request and noise."""
    components, count = noise.shape
    layout = tuned.memory(tuple(f"q{k}" for k in range(components)))
    r, n, m = (ca.SX.sym(name, size) for name, size in (("r", components), ("n", components), ("m", layout.size)))
    request, following = tuned.step(r, r + n, ca.SX.zeros(components), layout.split(m))
    step = ca.Function("s", [ca.vertcat(r, m), n], [ca.vertcat(request, layout.join(following))])
    log = step.mapaccum("run", count)(np.append(np.zeros(components), layout.start()), noise).full()
    return log[components + layout.slice("tuner_factor").start]


@pytest.mark.parametrize("components", [1, 2, 3, 4, 5])
def test_the_tuner_is_its_rule_in_numpy(components):
    """Growing errors, two-cycles, and noise around them; the mean sign of white noise is that of scipy's beta function."""
    random, target, cap, half = np.random.default_rng(components), 0.5, 1.3, components / 2
    swing = np.concatenate([np.cumprod(random.uniform(0.9, g, 60)) for g in (2.5, 1.15, 1.3, 1.02)] + [np.ones(60)])
    noise = random.choice([0.0, 0.1, 3.0], len(swing)) * random.standard_normal((components, len(swing)))
    noise = np.tile(noise + swing * (-1) ** np.arange(len(swing)), 4)
    noise = np.hstack([np.cumsum(np.ones((components, 60)), axis=1), noise])  # a ramp first
    tuned = fp.Tuned(fp.Affine(gain=-1.0), largest_gain=0.5 * cap, target=target)
    factor, growing, returning, expected = 1.0, 0.0, 0, []
    request = before = earlier = np.zeros(components)
    for error in noise.T:
        error = request + error
        turned, size = error @ before < 0, error @ error
        much = size > (1.0 if factor < 1 else 1.5) ** 2 * (before @ before)
        growing = growing + (1 if much else 1 / 3) if turned and size > before @ before else 0
        back = (error - earlier) @ (error - earlier) < 0.3**2 * size
        returning = returning + 1 if turned and back else 0
        mean = 2 * betainc(half, half, (1 - max(target, 1.0 if factor < 1 else 0.0) / 2) / 2) - 1
        sign = np.sign(error @ before)
        tuned_to = factor * np.exp(0.02 * (sign - mean) * abs(sign))
        tuned_to = min(max(tuned_to, 1e-3 if factor < 1 else 1.0), cap)
        if growing > 5 - 1 / 6 or returning >= 8:
            tuned_to, growing, returning = max(factor / 2, 1e-3), 0, 0
        request = request - factor * 0.5 * error
        factor, before, earlier = tuned_to, error, before
        expected.append(factor)
    np.testing.assert_allclose(factors_of(tuned, noise), expected, rtol=1e-9)
    assert (min(expected), max(expected)) == (0.001, cap)


@pytest.mark.parametrize(("start", "components"), [(0.02, 1), (0.1, 3)])
@pytest.mark.parametrize("target", [0.3, 0.5, 1.0])
def test_tuner_settles_at_its_target_in_noise(start, components, target):
    """Any start below the target: the mean of log(a lambda) is that of the target within 0.15."""
    tuned = fp.Tuned(fp.Affine(gain=-2 * start), largest_gain=1.9, target=target)
    gain = start * in_noise(tuned, components, 40_000, seed=1)[10_000:]
    assert np.log(gain).mean() == pytest.approx(np.log(target), abs=0.15)


@pytest.mark.parametrize(("product", "components"), slow_but([(0.5, 2), (0.9, 3), (1.5, 1)], (0.9, 3)))
def test_false_alarms_are_as_rare_as_stated(product, components):
    """100 000 cycles, the cap is the floor: at most one alarm up to a product of 0.9, one in 7000 cycles at 1.5."""
    tuned = fp.Tuned(fp.Affine(gain=-2 * product), largest_gain=product)
    factor = in_noise(tuned, components, 100_000, seed=0)
    assert np.sum(np.diff(factor) < -0.3) <= (1 if product < 1 else 14)
    assert factor.max() == 1.0
    # Below the floor the target is a product of 1: there, or at the floor, the factor ends.
    assert factor.mean() > (0.99 if product < 1 else 0.8)


def test_tuner_leaves_a_saturated_two_cycle():
    """A kick puts the map at twice its limit into a two-cycle, where errors neither grow nor die out: the tuner ends it."""
    sigmoid = fp.Sigmoid(gain=-1.0, scale=1.0).with_effective_gain(1.0)
    left = []
    for deformation in (fp.Tuned(sigmoid, largest_gain=1.5), sigmoid):
        step, value = Scalar(deformation), 30.0
        for _ in range(400):
            value = step(value, 4 * value, 1.0)
        left.append(abs(4 * value - 1.0))
    assert left[0] < 1e-3
    assert left[1] > 1.0


# A denoiser in place of a low-pass


def denoised(errors: np.ndarray, **settings: Any) -> np.ndarray:
    """The errors as Haar gives them to its map: with Affine(gain=-2) and d = 0 a step moves the request by -g."""
    step = Scalar(fp.Haar(fp.Affine(gain=-2.0), **settings))
    return np.array([-step(0.0, error, 0.0) for error in errors])


def test_a_denoiser_passes_jumps_at_once_and_averages_what_is_small():
    """A jump beyond the noise is whole; what is small is numpy's moving average over 2^J samples."""
    jump = np.concatenate([np.zeros(20), np.full(60, 7.0)])
    np.testing.assert_allclose(denoised(jump, noise=7 / 13), jump, atol=1e-12)  # 3 2^(J/2) times and more
    errors = 0.01 * np.random.default_rng(1).normal(size=200)
    mean = np.convolve(errors, np.full(8, 1 / 8))[:200]
    np.testing.assert_allclose(denoised(errors, noise=1.0, levels=3), mean, atol=1e-15)
    # Of a normal detail 0.3 % pass three deviations, so the deviation is near that of the mean, a quarter for four levels.
    noise = np.random.default_rng(2).normal(size=4000)
    assert 0.25 < np.std(denoised(noise, noise=1.0)[16:]) < 0.4
