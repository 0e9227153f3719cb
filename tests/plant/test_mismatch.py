"""A mismatch of P percent is the same range of the exact parameters in a review and in a study of scenarios."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem, InvalidValue
from fpirhc.plant.mismatch import exact_ranges
from fpirhc.review.grid import review_grid
from fpirhc.studies.scenarios.draws import COMPARING, draw

# The approximate values are the exact ones, so that the box of a review is the range alone; one is negative, one bounded.
VALUES = {"b": 1.6, "k": -5.0, "c": 0.5, "zero": 0.0}
BOUNDS = {"c": (0.3, 1.0)}
EVERYWHERE = (-float("inf"), float("inf"))


@pytest.fixture
def problem() -> fp.Problem:
    """A mass on a line."""
    parameters = {n: fp.Parameter(v, v, "1", BOUNDS.get(n, EVERYWHERE)) for n, v in VALUES.items()}
    plant = fp.Plant(
        {"y": "m"}, {"u": "N"}, parameters, lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y - p.c * v.y + p.zero}
    )
    reference = fp.Trajectory(lambda t: {"y": ca.sin(t)})
    return fp.Problem(plant=plant, reference=reference, start={"y": 0.0}, period=0.01, duration=1.0)


def test_the_range_by_value(problem):
    """20 % of 1.6 is 0.32; a parameter keeps its sign, and zero stays zero."""
    ranges = exact_ranges(problem.plant, 20.0)
    assert ranges["b"] == pytest.approx((1.28, 1.92))
    assert ranges["k"] == pytest.approx((-6.0, -4.0))
    assert ranges["zero"] == (0.0, 0.0)


def test_review_and_scenarios_mean_the_same_range(problem):
    """The box of a review is the range, its corners are met, and draws of scenarios fill it without leaving it."""
    ranges = exact_ranges(problem.plant, 20.0)
    least, largest = (np.array([r[k] for r in ranges.values()]) for k in (0, 1))
    reviewed = review_grid(problem, 20.0, 0).draws
    drawn = np.array([draw(problem.plant, seed=0, use=COMPARING, number=k, percent=20.0).exact for k in range(400)])
    for rows in (reviewed, drawn):
        assert np.all(rows >= least - 1e-12)
        assert np.all(rows <= largest + 1e-12)
        assert np.ptp(rows, axis=0) == pytest.approx(largest - least, rel=0.02, abs=1e-12)


def test_a_review_refuses_what_scenarios_refuse(problem):
    """The parameter c = 0.5 may shrink by 40 % to its bound of 0.3; both say so in the same words."""
    controllers = {"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0))}
    assert fp.review(problem, controllers, mismatch=39.0, seed=0).mismatch == 39.0
    with pytest.raises(InvalidProblem, match=r"parameter 'c'.*at most 40 % stay inside"):
        fp.review(problem, controllers, mismatch=41.0, seed=0)
    for wrong, words in (
        (100.0, "at least 0 and below 100"),
        (-1.0, "at least 0 and below 100"),
        (math.nan, "a number, got nan"),
    ):
        with pytest.raises(InvalidValue, match=words):
            fp.review(problem, controllers, mismatch=wrong, seed=0)
