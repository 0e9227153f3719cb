"""A review's question about the discretisation of the horizon: poles of a stage against poles of the plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.review.answer import Verdict
from fpirhc.review.discretisation import discretisation_follows
from fpirhc.review.grid import review_grid

PLANT = fp.Plant(
    coordinates={"x": "m"},
    inputs={"u": "m/s"},
    order=1,
    response=lambda q, u, p: {"x": -p.rate * q.x + u.u},
    parameters={"rate": fp.Parameter(40.0, 40.0, "1/s")},
)
HORIZON = fp.Horizon(stages=10, step=0.1)
PROBLEM = fp.Problem(
    plant=PLANT,
    reference=fp.Trajectory(lambda t: {"x": 0.1 * t}),
    start={"x": 0.0},
    period=0.1,
    duration=1.0,
    limits=fp.Limits(inputs={"u": (-10.0, 10.0)}),
    horizon=HORIZON,
    cost=fp.Quadratic(states={"x": 1.0}, effort={"u": 0.1}),
)


@pytest.mark.parametrize(
    ("method", "verdict", "pole"),
    [
        (fp.RungeKutta4(), Verdict.NO, 1 - 4 + 8 - 64 / 6 + 256 / 24),
        (fp.Euler(), Verdict.NO, 3.0),
        (fp.RungeKutta4(8), Verdict.YES, np.exp(-4)),
        (fp.ImplicitMidpoint(), Verdict.UNKNOWN, 1 / 3),
        (fp.RadauIIA(4), Verdict.YES, np.exp(-4)),
    ],
)
def test_poles_of_a_stage(method, verdict, pole):
    """Lambda h = -4: the stability functions of the methods, and what follows from them."""
    problem = replace(PROBLEM, horizon=replace(HORIZON, discretisation=method))
    answer = discretisation_follows(review_grid(problem, 0.0, 0))
    assert answer is not None
    assert answer.verdict == verdict
    assert answer.numbers["fastest_mode"] == pytest.approx(40.0)
    assert answer.numbers["largest_pole"] == pytest.approx(abs(pole), abs=2e-3)


def test_a_problem_without_a_horizon_is_not_asked():
    """There is nothing to discretise."""
    assert discretisation_follows(review_grid(replace(PROBLEM, horizon=None, cost=None), 0.0, 0)) is None
