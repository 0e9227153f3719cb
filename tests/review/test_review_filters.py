"""A filter that estimates what the model lacks is judged with the loop: it is the iteration, and has its limit."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from plants import heavy

import fpirhc as fp
from fpirhc.review.questions.margins import SLOWER
from fpirhc.review.review import review

DEVIATIONS = {"y''": 1e-3, "y'": 1.0, "y": 1.0}  # the response is measured far better: L is near 1


def cart(gain: float) -> fp.Problem:
    """A mass whose response is `gain` times the model's."""
    sine = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    return fp.Problem(heavy(1.0, 1 / gain, q="y"), sine, start={"y": 0.0}, period=1e-2, duration=5.0)


def spring(gain: float) -> fp.Problem:
    """The same with a spring and a damper that the model has half."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.0, 1 / gain, "kg"), "k": fp.Parameter(2.0, 4.0, "N/m")},
        response=lambda q, v, u, p: {"y": (u.u - p.k * q.y - 0.1 * p.k * v.y) / p.m},
    )
    return replace(cart(gain), plant=plant)


LAW = fp.ComputedTorque(fp.Exponential(3.0))
FILTER = fp.Estimating(LAW, fp.DisturbanceKalman({"y": 1.0}, DEVIATIONS), at_once=True)


@pytest.mark.parametrize(("gain", "stable"), [(0.5, True), (1.5, True), (1.9, True), (2.1, False), (3.0, False)])
def test_a_filter_of_the_response_has_the_limit_of_the_iteration(gain, stable):
    """With L near 1 the factor per cycle is 1 - L gain: no beyond a gain of 2 / L, and the gain margin is the rest up to there."""
    problem = cart(gain)
    answers = review(problem, {"filter": FILTER}, mismatch=0.0, seed=0).controllers["filter"]
    [numbers] = [one.numbers for one in answers if "radius" in one.numbers and "margin" in one.question]
    assert (numbers["radius"] < 1) == stable
    assert (fp.simulate(problem, FILTER, seed=0, compiled=False).stop is None) == stable
    if gain > 1:
        assert any(one.verdict == "no" for one in answers) != stable
    if stable and gain > 1:
        assert gain * numbers["gain_margin"] == pytest.approx(1.92, rel=0.01)  # the law around it takes 4 % of 2 / L


@pytest.mark.parametrize("drift", [1e-3, 1.0])
@pytest.mark.parametrize("gain", [0.5, 1.0, 1.9])
def test_a_filter_of_responses_alone_is_the_model_referenced_form_of_its_gain(gain, drift):
    """It has the measured state in place of one of its own: commands are equal to rounding, whatever the model lacks."""
    problem = spring(gain)
    kalman = fp.DisturbanceKalman({"y": drift}, {"y''": 1e-4})
    alone = fp.Estimating(LAW, kalman, at_once=True)
    filtered = kalman.gain(alone.inner_problem(problem))
    assert not filtered[:2].any()
    form = fp.ComputedTorque(LAW.tracking, fp.ModelReferenced(fp.Affine(-2 * filtered[2, 0])))
    one, other = (fp.simulate(problem, c, seed=0, compiled=False) for c in (alone, form))
    assert np.abs(one["command"] - other["command"]).max() < 1e-12 * np.abs(one["command"]).max()


def test_a_filter_with_little_margin_is_told_to_learn_more_slowly():
    """Its margin is that of the gain L; the rate of the law around it is not the cause."""
    answers = review(cart(1.7), {"filter": FILTER}, mismatch=0.0, seed=0).controllers["filter"]
    [margin] = [one for one in answers if "gain_margin" in one.numbers]
    assert margin.verdict == "unknown"
    assert margin.change == SLOWER
