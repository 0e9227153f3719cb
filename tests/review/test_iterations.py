"""A review recommends numbers: iterations of the optimiser that suffice, and gain and filter pole for the sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_review_laws import RATE, answer, moving, steps_in_a_run

import fpirhc as fp


def test_an_optimiser_says_whether_it_has_iterations():
    """Two settings bound the work of the fixed point; one bounds IPOPT's."""
    assert fp.FixedPoint(iterations=3, tolerance=1e-3).longer(4) == fp.FixedPoint(
        iterations=12, tolerance=1e-3, most_iterations=400
    )
    assert fp.Ipopt(tolerance=1e-3).longer(2) == fp.Ipopt(tolerance=1e-3, iterations=400)


# The pair of gain and filter pole that a review recommends for the sensors of a problem


WORDS = "sensors' noise asks for"
NOISY = moving(sensing=fp.Sensing({"y''": fp.Sensor(noise=fp.Noise(1.0))}))
LIMITED = replace(NOISY, limits=fp.Limits(inputs={"u": (-20.0, 20.0)}))


def test_the_pair_keeps_its_budget_in_a_run():
    """1 % of 40 N: the pair's rms step is 0.4 N, and the review is content with it. The tracking law damps a tenth."""
    advice = answer(LIMITED, fp.Affine(gain=-1.5), WORDS)
    assert advice.verdict == "caution"
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
    """No limits, no range: the gain in use sets the price, and a filter with four times the gain costs more in the whole loop.

    By itself the filtered iteration has the chatter of the gain in use; the tracking law makes it swing, as a run does.
    """
    advice = answer(NOISY, fp.Affine(gain=-0.2), WORDS)
    assert (advice.verdict, advice.change) == ("yes", "")
    pair = fp.Filtered(fp.Affine(gain=-0.863), pole=0.892)
    told = [answer(NOISY, one, "chatter").numbers["step_u"] for one in (fp.Affine(gain=-0.2), pair)]
    ran = [steps_in_a_run(NOISY, fp.ComputedTorque(fp.Exponential(rate=RATE), m)) for m in (fp.Affine(gain=-0.2), pair)]
    assert told == pytest.approx(ran, rel=0.08)
    assert told[1] > 1.3 * told[0]


def test_without_noise_nothing_is_asked():
    """A quiet sensor needs no filter."""
    assert answer(moving(), fp.Affine(gain=-0.5), WORDS) is None
