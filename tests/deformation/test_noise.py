"""Gain and filter pole for a budget of chatter: covariances against simulated noise, the suggestion against runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp


def noisy() -> fp.Problem:
    noise = {name: fp.Sensor(noise=fp.Noise(1.0)) for name in ("q1''", "q2''")}  # m/s^2
    return replace(fp.load_problem("two_mass").problem, sensing=fp.Sensing(noise))


# --- A denoiser in place of a low-pass ------------------------------------------------------------------------------------


def denoised(errors: np.ndarray, **settings: Any) -> np.ndarray:
    """The errors as Haar gives them to its map: with Affine(gain=-2) and d = 0 a step moves the request by -g."""
    deformation = fp.Haar(fp.Affine(gain=-2.0), **settings)
    request, response, past = (ca.SX.sym(n, k) for n, k in (("r", 1), ("f", 1), ("m", 2**deformation.levels - 1)))
    after, memory = deformation.step(request, response, ca.SX.zeros(1), {"haar_errors": past})
    step = ca.Function("step", [request, response, past], [after, memory["haar_errors"]])
    held, passed = ca.DM.zeros(past.numel()), []
    for error in errors:
        moved, held = step(0.0, error, held)
        passed.append(-float(moved))
    return np.array(passed)


def test_a_jump_beyond_the_noise_passes_at_once_and_whole():
    errors = np.concatenate([np.zeros(20), np.full(60, 7.0)])
    np.testing.assert_allclose(denoised(errors, noise=0.1), errors, atol=1e-12)


def test_what_is_small_is_a_mean():
    """Independent: numpy's moving average over 2^J samples."""
    errors = 0.01 * np.random.default_rng(1).normal(size=200)
    mean = np.convolve(errors, np.full(8, 1 / 8))[:200]
    np.testing.assert_allclose(denoised(errors, noise=1.0, levels=3), mean, atol=1e-15)


def test_white_noise_of_the_stated_deviation_is_averaged():
    """Of a normal detail 0.3 % pass three deviations, so the deviation is near that of the mean, a quarter for four levels."""
    noise = np.random.default_rng(2).normal(size=4000)
    assert 0.25 < np.std(denoised(noise, noise=1.0)[16:]) < 0.4
