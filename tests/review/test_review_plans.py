"""What a review states about plans that weigh the change of their inputs, or must meet an end, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from plants import heavy
from reviewed import about

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along

STEP = 0.05  # s


def oscillator(**settings: Any) -> fp.Problem:
    """M q'' = u - k q at rest; model and plant are the same."""
    usual: dict[str, Any] = {
        "reference": fp.Trajectory(lambda t: {"q": 0 * t}),
        "start": {"q": 0.1},
        "period": STEP,
        "duration": 10.0,
        "horizon": fp.Horizon(stages=60, step=STEP),
        "cost": fp.Quadratic(states={"q": 1e2, "q'": 1.0}, rate={"u": 0.5}),
    }
    return fp.Problem(heavy(1.0, 1.0, (4.0, 4.0)), **(usual | settings))


def model_of_a_stage() -> tuple[np.ndarray, np.ndarray]:
    """A and B of the oscillator over one stage."""
    whole = scipy.linalg.expm(np.array([[0, 1, 0], [-4, 0, 1], [0, 0, 0]]) * STEP)
    return whole[:2, :2], whole[:2, 2:]


def rate_weighted_gain(weight: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stationary gain of the state and the input before, with the matrices of this augmented system."""
    a, b = model_of_a_stage()
    wide, entry = scipy.linalg.block_diag(a, 0.0), np.vstack([b, [[1.0]]])
    q, r, s = np.diag([1e2, 1.0, weight]), np.array([[weight]]), np.array([[0.0], [0.0], [-weight]])
    value = scipy.linalg.solve_discrete_are(wide, entry, q, r, s=s)
    gain = -np.linalg.solve(r + entry.T @ value @ entry, entry.T @ value @ wide + s.T)
    return gain, wide, entry


def answers(problem: fp.Problem, controller: Controller) -> dict[str, fp.Answer]:
    report = fp.review(problem, {"it": controller}, mismatch=0.0, seed=0)
    return {a.question: a for a in report.answers}


PLAIN = fp.RecedingHorizon(fp.FixedPoint(iterations=3, tolerance=1e-3))


def test_loop_of_a_rate_weighted_plan_has_the_poles_of_its_closed_form():
    """One cycle per stage: the poles of state and input before under the stationary gain."""
    problem = oscillator()
    [loop, *_] = loops_along(review_grid(problem, 0.0, 0), PLAIN).loops
    gain, wide, entry = rate_weighted_gain()
    expected = np.linalg.eigvals(wide + entry @ gain)
    for pole in expected:
        assert np.abs(loop.poles - pole).min() < 1e-3
    assert loop.radius == pytest.approx(np.abs(expected).max(), abs=1e-4)


def test_several_cycles_per_stage_change_the_input_as_slowly():
    """Ten cycles per stage: a slow plan settles in the same time, not in a tenth of it."""
    slow = fp.Quadratic(states={"q": 1e2, "q'": 1.0}, rate={"u": 1e4})
    rates = []
    for period in (STEP, STEP / 10):
        problem = oscillator(cost=slow, period=period)
        [loop, *_] = loops_along(review_grid(problem, 0.0, 0), PLAIN).loops
        rates.append(np.log(loop.radius) / period)
    assert rates[1] == pytest.approx(rates[0], rel=0.1)


def test_nothing_is_unknown_about_a_rate_weighted_plan():
    """Horizon, rates, zero dynamics, margins, convergence and box have answers of their own."""
    adaptive = replace(PLAIN, deformation=fp.ModelReferenced(fp.Sigmoid(gain=-0.5, scale=20.0)))
    every = answers(oscillator(), adaptive)
    for words in (
        "horizon long",
        "sampling fast enough",
        "zero dynamics",
        "margin",
        "deformation converge",
        "box of par",
    ):
        assert about(every, words).verdict == "yes", about(every, words)
    assert "radius" in about(every, "margin").numbers
