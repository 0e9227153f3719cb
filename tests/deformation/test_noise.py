"""Gain and filter pole for a budget of chatter: covariances against simulated noise, the suggestion against runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from plants import sine_of_three
from scipy.signal import lfilter

import fpirhc as fp
from fpirhc.errors import InvalidName, InvalidValue, NotContractive, NotSupported
from fpirhc.review.grid import review_grid
from fpirhc.review.questions.noise import Noisy, Suggestion, _largest_within, _within_budget, noisy_points

SETTINGS = [(0.198, 0.0, 1.5), (0.5, 0.0, 1.0), (0.59, 0.78, 1.5), (0.97, 0.91, 1.5), (1.9, 0.8, 1.0)]
BUDGET = {"Q1": 0.32, "Q2": 0.555}  # N; what the plain gain -0.5 makes of a noise of 1 m/s^2


def loops_behind_noise(eigenvalue: float, rate: float = 0.1) -> Noisy:
    """A mass whose response has this eigenvalue, under a law that is slow beside the iteration, with noise of 2 m/s^2."""
    noise = fp.Sensing({"y''": fp.Sensor(noise=fp.Noise(2.0))})
    problem = replace(sine_of_three(eigenvalue), duration=1.0, measure_from=0.0, sensing=noise)
    law = fp.ComputedTorque(fp.Exponential(rate), fp.Filtered(fp.Affine(gain=-0.3), pole=0.9))
    return noisy_points(review_grid(problem, 0.0, 0), law, {"y": 2.0})


@pytest.mark.parametrize(("gain", "pole", "eigenvalue"), SETTINGS)
def test_chatter_of_one_coordinate_is_the_closed_form(gain, pole, eigenvalue):
    """2 a^2 (1 - p) / (2 (1 + p) - a lambda (1 - p)) of the noise's variance is the filter's own, and that of a million cycles."""
    found = loops_behind_noise(eigenvalue).steps(gain, pole)  # the model's input is its response
    width = 2 * (1 + pole) - gain * eigenvalue * (1 - pole)
    assert found[0] ** 2 == pytest.approx(4 * 2 * gain**2 * (1 - pole) / width, rel=0.01)
    # r = -a g / (1 - z^-1), g = (1 - p)(lambda r z^-1 + n) / (1 - p z^-1).
    share, noise = gain * (1 - pole), np.random.default_rng(2).normal(scale=2.0, size=1_000_000)
    request = lfilter([-share], [1.0, -(1 + pole) + share * eigenvalue, pole], noise)
    assert np.var(np.diff(request)) == pytest.approx(found[0] ** 2, rel=0.03)


def test_chatter_of_a_gain_beyond_the_limit_is_infinite():
    assert np.isinf(loops_behind_noise(1.0).steps(2.1, 0.0)).all()


def test_chatter_that_grows_from_next_to_nothing_is_found():
    """A gain too small for its tracking law: the loop grows by 1.002 in a cycle, and noise enters the map as 1e-8 of its size."""
    assert (loops_behind_noise(1.5, rate=20.0).steps(1e-4, 0.999975) > 1e9).all()


def noisy() -> fp.Problem:
    noise = {name: fp.Sensor(noise=fp.Noise(1.0)) for name in ("q1''", "q2''")}  # m/s^2
    return replace(fp.load_problem("two_mass").problem, sensing=fp.Sensing(noise))


def planning() -> fp.RecedingHorizon:
    return fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=5e-2), fp.Sigmoid(gain=-0.5, shift=0.3, scale=20.0))


@cache
def ran(ringing: float, noise: bool) -> tuple[Suggestion, float, np.ndarray, np.ndarray]:
    """Suggestion, mean rms error (m), rms steps of the commands (N) and rms errors from 3 s on, of one run."""
    problem = noisy()
    suggestion = fp.suggest(problem, planning(), chatter=BUDGET, ringing=ringing)
    shown = problem if noise else replace(problem, sensing=fp.Sensing())
    run = fp.simulate(shown, replace(planning(), deformation=suggestion.deformation), seed=11)
    errors = np.array(list(fp.measure(shown, run).rms_error.values()))
    return suggestion, float(errors.mean()), np.std(np.diff(run["command"][3000:], axis=0), axis=0), errors


@pytest.mark.parametrize(
    ("ringing", "published"),
    [
        pytest.param(0.0, 0.564e-3, marks=pytest.mark.slow),
        pytest.param(1.0, 0.341e-3, marks=pytest.mark.slow),
        (4.0, 0.245e-3),
    ],
)
def test_filter_buys_tracking_at_the_same_chatter(ringing, published):
    """Two masses, accelerometers with 1 m/s^2: errors 0.56, 0.34, 0.24 mm, with the same steps of the commands each time."""
    suggestion, error, steps, _ = ran(ringing, True)
    assert error == pytest.approx(published, rel=0.08)
    quiet = ran(ringing, False)[2]
    predicted = np.array(list(suggestion.chatter.values()))
    np.testing.assert_allclose(np.sqrt(steps**2 - quiet**2), predicted, rtol=0.06)
    assert max(predicted / np.array(list(BUDGET.values()))) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
def test_floor_is_what_noise_leaves_of_tracking():
    """With a fast iteration the error that noise adds is the predicted floor, to 20 %."""
    suggestion, _, _, errors = ran(6.0, True)
    quiet = ran(6.0, False)[3]
    np.testing.assert_allclose(np.sqrt(errors**2 - quiet**2), list(suggestion.floor.values()), rtol=0.2)


def test_generous_budget_ends_at_the_deadbeat_gain():
    """More gain than the inverse of the largest eigenvalue (1.5) buys nothing, so the chatter stays below its budget."""
    suggestion = fp.suggest(noisy(), planning(), chatter=100.0)
    assert suggestion.effective_gain == pytest.approx(1 / 1.5)
    assert max(suggestion.chatter.values()) < 10
    assert "gain" in repr(suggestion)
    assert "Suggested" in suggestion._repr_html_()


def always(steps: float) -> Callable[[float], np.ndarray]:
    return lambda _: np.array([steps])


def test_no_gain_within_a_budget_is_told_apart_from_no_gain_at_all():
    """Chatter that is three times the budget with every gain is a matter of the budget; a loop that always grows is not."""
    for steps, words in ((3.0, "at least 3 times as large"), (np.inf, "converges with no effective gain")):
        with pytest.raises(NotContractive, match=words):
            _largest_within(always(steps), np.array([1.0]), 1.0)


@pytest.mark.slow
def test_a_suggestion_that_a_run_speaks_against_says_so():
    """The plain form disturbs a right model, the more the smaller its gain; with the wrong one every gain within a budget helps."""
    assert not fp.suggest(noisy(), planning(), chatter=BUDGET).harm
    right, eighth = noisy().with_exact(noisy().plant.approximate), {name: value / 8 for name, value in BUDGET.items()}
    small = fp.suggest(right, planning(), chatter=eighth, ringing=0.0)
    assert small.harm.startswith("with the wrong model the rms error of q1 is 0.000168 m without adaptation, 0.0")
    assert small.harm in repr(small)


def test_suggestion_keeps_the_other_wrappers():
    """A filter is replaced, a guard around it stays, and so does the sign of the gain."""
    guarded = fp.Guarded(fp.Filtered(fp.Affine(gain=-0.1), pole=0.99), largest_deformation=1e3)
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), guarded)
    suggestion = fp.suggest(noisy(), controller, chatter=0.3, noise={"q1": 1.0})
    assert isinstance(suggestion.deformation, fp.Guarded)
    assert suggestion.deformation.map == fp.Filtered(fp.Affine(gain=suggestion.gain), pole=suggestion.pole)
    assert suggestion.gain < 0
    assert fp.suggest(noisy(), controller, chatter=0.3, ringing=0.0).pole == 0


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"chatter": -1.0}, InvalidValue, "positive rms step"),
        ({"chatter": {"Q1": 0.0}}, InvalidValue, "positive rms step"),
        ({"chatter": {"Q3": 1.0}}, InvalidName, "Q3"),
        ({"chatter": 1.0, "noise": {"q3": 1.0}}, InvalidName, "q3"),
        ({"chatter": 1.0, "noise": {"q1": -1.0}}, InvalidValue, "standard deviation"),
        ({"chatter": 1.0, "noise": {}}, InvalidValue, "no response has noise"),
        ({"chatter": 1.0, "ringing": -1.0}, InvalidValue, "ringing: .* at least 0"),
    ],
)
def test_suggest_refuses_bad_input(settings, error, words):
    """Negative budgets and unknown names are told with what is expected."""
    with pytest.raises(error, match=words):
        fp.suggest(noisy(), planning(), **settings)


def test_suggest_needs_a_deformation_and_white_noise():
    """Without adaptation there is nothing to choose; the noise of an estimated response must be given."""
    with pytest.raises(NotSupported, match="no deformation"):
        fp.suggest(noisy(), replace(planning(), deformation=fp.Identity()), chatter=1.0)
    sensing = fp.Sensing({"q1'": fp.Sensor(noise=fp.Noise(1e-3))}, fp.VelocityDifference())
    estimated = replace(noisy(), sensing=sensing)
    with pytest.raises(InvalidValue, match="not white"):
        fp.suggest(estimated, planning(), chatter=1.0)
    assert fp.suggest(estimated, planning(), chatter=1.0, noise={"q1": 1.4, "q2": 1.4}).pole > 0


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


def test_where_every_filter_makes_the_loop_grow_a_gain_without_one_is_suggested(monkeypatch):
    """As behind an arm whose second eigenvalue is a third of the first: noise grew with every filter, and nothing was suggested."""
    steps = Noisy.steps
    monkeypatch.setattr(Noisy, "steps", lambda loops, gain, pole: steps(loops, gain, pole) + (np.inf if pole else 0.0))
    found, without = (_within_budget(noisy(), planning(), BUDGET, ringing=ringing) for ringing in (6.0, 0.0))
    assert found.pole == 0
    assert found.effective_gain == without.effective_gain != 0
