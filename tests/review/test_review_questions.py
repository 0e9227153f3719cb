"""Questions of a review that are files of their own: wrong parameters that nothing corrects, limits that the reference leaves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
from plants import heavy

import fpirhc as fp

# Parameters


# Limits


def mass(amplitude: float = 0.5, **limits: Any) -> fp.Problem:
    """2 kg along A sin t with a plan; the force that this needs is -2 A sin t."""
    return fp.Problem(
        heavy(2.0, 2.0),
        fp.Trajectory(lambda t: {"q": amplitude * ca.sin(t)}),
        start={"q": 0.0, "q'": amplitude},
        period=0.1,
        duration=10.0,
        limits=fp.Limits(**limits),
        horizon=fp.Horizon(stages=10, step=0.1),
        cost=fp.Quadratic(states={"q": 1.0}, effort={"u": 1e-3}),
    )


KEEPS = "keep the limits of states"


def test_no_limit_is_left_where_nobody_is_drawn_to_the_reference():
    """An economic cost has no reference in it: what it would need is no question; with the error in the cost it is one."""
    for weight, count in ((0.0, 0), (1.0, 1)):

        def cost(v, weight=weight):
            return {"effort": v.input.u**2, "error": weight * (v.state.q - v.reference.q) ** 2}

        problem = replace(mass(states={"q": (-0.4, 0.6)}), cost=fp.CustomCost(cost))
        asked = fp.review(problem, {}, mismatch=0.0, seed=0).answers
        assert sum(KEEPS in one.question for one in asked) == count


# Reasons
