"""A tuner finds its gain on line, follows jumps of the plant's, and survives noise; a denoiser in place of a low-pass."""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.iteration import Scalar
from scipy.special import betainc

import fpirhc as fp

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
    assert fp.Tuned(fp.Affine(gain=-2.0), largest_gain=1.0).largest_gain == 1.0  # a gain at its bound may stand
    step = Scalar(fp.Tuned(fp.Affine(gain=-0.5), largest_gain=0.8))
    for response in (1.0, np.nan, 1.0, 1.0, 1.0):
        step(0.0, response, 0.5)
    assert np.isfinite(step.memory.full()).all()


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
    tuned = fp.Tuned(fp.Affine(gain=-1.0), largest_gain=0.5 * cap)
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
    assert [denoised(np.full(300, 0.5), noise=1.0, levels=n)[0] for n in (1, 8)] == [0.25, 0.5 / 256]
    # Of a normal detail 0.3 % pass three deviations, so the deviation is near that of the mean, a quarter for four levels.
    noise = np.random.default_rng(2).normal(size=4000)
    assert 0.25 < np.std(denoised(noise, noise=1.0)[16:]) < 0.4
