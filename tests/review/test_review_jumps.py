"""Jumps of a reference, which the symbols do not show: a step by `if_else` has the derivative zero everywhere."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from kinds import shipped
from plants import heavy

import fpirhc as fp
from fpirhc.review.grid import review_grid
from fpirhc.review.questions.reference import jumps, reference_free_of_jumps


def mass(motion: Callable[[Any], Any], **settings: Any) -> fp.Problem:
    """Two kilograms and a force."""
    usual: dict[str, Any] = {"start": {"q": 0.0}, "period": 1e-2, "duration": 4.0}
    return fp.Problem(heavy(3.0, 2.0), fp.Trajectory(lambda t: {"q": motion(t)}), **(usual | settings))


def stepping(at: float, size: float, smooth: float) -> fp.Problem:
    """A step on a sine of the amplitude `smooth`."""
    return mass(lambda t: smooth * ca.sin(t) + ca.if_else(t < at, 0, size))


def answer(problem: fp.Problem) -> fp.Answer:
    return reference_free_of_jumps(review_grid(problem, 0.0, 0))


@pytest.mark.parametrize("at", [1.0, 1.23456, 3.999])
@pytest.mark.parametrize("size", [0.5, -1e-3])
def test_a_step_is_found_where_it_is(at, size):
    """On a cycle, between two cycles and just before the end of the run, alone and on a motion a thousand times larger."""
    for smooth in (0.0, 1.0):
        [jump] = jumps(stepping(at, size, smooth))
        assert jump.state == "q"
        assert jump.time == pytest.approx(at, abs=1e-6)
        assert jump.size == pytest.approx(size, rel=1e-6)


def test_a_kink_is_a_jump_of_the_speed():
    """A ramp from one second on: the speed jumps, the position does not."""
    [jump] = jumps(mass(lambda t: 2 * ca.fmax(t - 1, 0)))
    assert jump.state == "q'"
    assert jump.size == pytest.approx(2.0)


@pytest.mark.parametrize(
    "motion",
    [
        lambda t: ca.sin(40 * t),
        lambda t: 0 * t,
        lambda t: ca.exp(3 * t),
        lambda t: ca.fmax(t - 1, 0) ** 2,  # the acceleration jumps, which a force can follow
        lambda t: ca.tanh((t - 2) / 0.02),
    ],
)
def test_smooth_motions_have_none(motion):
    """Fast, constant, growing, piecewise quadratic and steep ones."""
    problem = mass(motion)
    assert jumps(problem) == []
    assert answer(problem).verdict == "yes"


def test_a_review_answers_no_and_gives_a_filtered_set_point_that_is_free_of_jumps():
    """The expression of the answer, taken as it is printed, is the mend."""
    problem = mass(lambda t: ca.if_else(t < 1.5, 0.2, 0.7))
    [one] = [a for a in fp.review(problem, {}, mismatch=0.0, seed=0).answers if "jumps" in a.question]
    assert one.verdict == "no"
    assert "q by 0.5 m at t = 1.5 s" in one.evidence
    expression = one.change.partition("set-point: ")[2].partition(" with s = ")[0]
    clock = one.change.partition(" with s = ")[2].partition(" rises")[0]

    def filtered(t: Any) -> Any:
        s = eval(clock, {"ca": ca, "t": t})
        return 0.2 + 0.5 * eval(expression, {"ca": ca, "w": 8.0, "s": s})

    mended = mass(filtered)
    assert answer(mended).verdict == "yes"
    state = mended.reference.function(mended.plant)
    assert float(state(1.5)[0][0]) == pytest.approx(0.2)
    assert float(state(4.0)[0][0]) == pytest.approx(0.7, abs=0.5 * 300 * math.exp(-8 * 2.5))
    assert np.isfinite(np.array(state(1.5)[1])).all()


@pytest.mark.parametrize("name", shipped())
def test_shipped_references_have_no_jumps(name):
    assert jumps(fp.load_problem(name).problem) == []
