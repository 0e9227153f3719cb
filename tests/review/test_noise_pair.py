"""The pair of gain and filter pole that a review recommends for the sensors of a problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_review_laws import RATE, answer, moving

import fpirhc as fp

WORDS = "sensors' noise asks for"
NOISY = moving(sensing=fp.Sensing({"y''": fp.Sensor(noise=fp.Noise(1.0))}))
LIMITED = replace(NOISY, limits=fp.Limits(inputs={"u": (-20.0, 20.0)}))


def test_the_pair_keeps_its_budget_in_a_run():
    """1 % of 40 N: the pair's rms step is 0.4 N, and the review is content with it. The tracking law damps a tenth."""
    advice = answer(LIMITED, fp.Affine(gain=-1.5), WORDS)
    assert advice.verdict == "unknown"
    assert "Filtered(map, pole=" in advice.change
    gain, pole = advice.numbers["recommended"], advice.numbers["recommended_pole"]
    pair = fp.Filtered(fp.Affine(gain=-2 * gain), pole=pole)
    assert pair.effective_gain() == pytest.approx(gain)
    assert answer(LIMITED, pair, WORDS).verdict == "yes"
    rest = replace(LIMITED, reference=fp.Trajectory(lambda t: {"y": 0 * t}), start={"y": 0.0}, duration=10.0)
    run = fp.simulate(rest, fp.ComputedTorque(fp.Exponential(rate=RATE), pair), seed=0, compiled=False)
    steps = np.diff(run["command"][2000:, 0])
    assert 0.85 * 0.4 < float(np.sqrt(np.mean(steps**2))) < 1.05 * 0.4


def test_without_limits_the_price_stays():
    """No limits, no range: the pair has the chatter of the gain in use, and adapts faster by its filter."""
    advice = answer(NOISY, fp.Affine(gain=-0.2), WORDS)
    pair = fp.Filtered(fp.Affine(gain=-2 * advice.numbers["recommended"]), pole=advice.numbers["recommended_pole"])
    same = answer(NOISY, pair, "chatter").numbers["step_u"]
    assert same == pytest.approx(answer(NOISY, fp.Affine(gain=-0.2), "chatter").numbers["step_u"], rel=1e-3)
    assert advice.numbers["recommended"] > 2 * advice.numbers["gain"]


def test_without_noise_nothing_is_asked():
    """A quiet sensor needs no filter."""
    assert answer(moving(), fp.Affine(gain=-0.5), WORDS) is None
