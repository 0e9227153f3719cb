"""Reviews of plants that are not shipped, answer by answer against what is known of them and against runs; see `tests/abroad`."""

from __future__ import annotations

from functools import cache

import abroad
import numpy as np
import pytest

import fpirhc as fp


@cache
def reviewed(name: str) -> tuple[fp.Answer, ...]:
    """All answers about RHC+FPI."""
    task = abroad.load(name)
    return fp.review(task.problem, {"RHC+FPI": task.controllers["RHC+FPI"]}, mismatch=0.0, seed=0).answers


# The quadruple tank


@pytest.mark.slow
def test_tanks_are_ready_and_their_run_agrees():
    """Every answer about RHC+FPI is yes or advice, and the run is better by a factor."""
    answers = {a.question: a.verdict for a in reviewed("quadruple_tank")}
    assert "no" not in answers.values()
    assert answers["Does the deformation converge?"] == "yes"
    assert answers["Does the deformation reach the wrong parameters?"] == "yes"
    task = abroad.load("quadruple_tank")
    errors = [
        np.abs(fp.simulate(task.problem, task.controllers[n], seed=0)["error"][200:]).max() for n in ("RHC", "RHC+FPI")
    ]
    assert errors[1] < 0.5 * errors[0]


# The flexible servo


@pytest.mark.slow
def test_the_servo_has_nothing_to_adapt():
    """The Jacobian is 1, the load's parameters are named, and adaptation does not lower the response error."""
    review = {a.question: a for a in reviewed("flexible_servo")}
    signs = review["Do the eigenvalues of the response Jacobian have one sign?"]
    assert (signs.numbers["smallest_over_box"], signs.numbers["largest_over_box"]) == pytest.approx((1.0, 1.0))
    reach = review["Does the deformation reach the wrong parameters?"]
    assert (reach.verdict, reach.evidence) == ("no", "the response does not depend on J_L, b_L")
    assert review["Does adaptation lower the response error?"].verdict == "no"


# The infusion of propofol


def test_minutes_are_minutes():
    """No text about the infusion has a second in it."""
    texts = [f"{a.evidence} {a.change}" for a in reviewed("drug_infusion")]
    assert not [t for t in texts if " 1/s" in t or " s " in t or "per second" in t]
    assert any(" 1/min" in t for t in texts)


# The half-rule model of Skogestad's process


# What a review says of the reactor and of a cart behind a dead time with a user's own map, against runs
