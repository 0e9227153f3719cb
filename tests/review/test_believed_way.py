"""The null test of a form that believes a lag or a dead time: its right model has them, too."""

from typing import Any

import pytest
from helpers import reviewed

import fpirhc as fp

LAG = 0.02  # s
MAP = fp.Affine(gain=-0.4)


def asked(problem: fp.Problem, deformation) -> Any:
    return reviewed.answers(problem, fp.ComputedTorque(fp.Exponential(rate=6.0), deformation))["model"]


def lagging() -> fp.Reality:
    """A mass on a spring behind an actuator: tau du/dt = u_c - u."""
    known, order = {"m": fp.Parameter(1.5, 1.0, "kg")}, {"q": 2, "acting": 1}
    moves = lambda q, v, u, p: {"q": (q.acting - 10 * q.q) / p.m, "acting": (u.u - q.acting) / LAG}  # noqa: E731
    behind = fp.Plant({"q": "m", "acting": "N"}, {"u": "N"}, known, moves, order=order)
    return fp.Reality(behind, start={"q": 0.0, "q'": 1.5, "acting": 0.0})


@pytest.mark.parametrize("reality", [None, lagging()])
def test_a_believed_lag_is_a_part_of_the_right_model(reality):
    """Beside a plant without lag and beside a real one: it leaves a right model alone, and no form is advised."""
    answer = asked(reviewed.mass(measure_from=1.0, reality=reality), fp.ModelReferenced(MAP, lag=LAG))
    assert (answer.verdict, answer.change) == ("yes", ""), answer
    assert answer.numbers["error_with"] == pytest.approx(answer.numbers["error_without"], rel=1e-3)


def test_a_believed_dead_time_is_a_part_of_the_right_model_too():
    """Where the problem states none; a dead time that it states is a fact."""
    assert asked(reviewed.mass(measure_from=1.0), fp.ModelReferenced(MAP, cycles=5.0, measurement=2.0)).verdict == "yes"
