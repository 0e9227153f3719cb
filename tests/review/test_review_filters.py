"""A filter that estimates what the model lacks is judged with the loop: it is the iteration, and has its limit."""

from __future__ import annotations

import casadi as ca
import pytest

import fpirhc as fp
from fpirhc.errors import NotSupported
from fpirhc.review.review import review

DEVIATIONS = {"y''": 1e-3, "y'": 1.0, "y": 1.0}  # the response is measured far better: L is near 1


def cart(gain: float) -> fp.Problem:
    """A mass whose response is `gain` times the model's."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(1.0, 1 / gain, "kg")},
        response=lambda q, v, u, p: {"y": u.u / p.m},
    )
    reference = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    return fp.Problem(plant=plant, reference=reference, start={"y": 0.0}, period=1e-2, duration=5.0)


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


def test_a_filter_of_responses_alone_is_refused():
    """The state could not be known from them; it was integrated without end."""
    alone = fp.Estimating(LAW, fp.DisturbanceKalman({"y": 1.0}, {"y''": 1e-3}))
    with pytest.raises(NotSupported, match="cannot be determined from y''"):
        fp.simulate(cart(1.5), alone, seed=0, compiled=False)
