"""The null test of a form that believes a lag or a dead time: its right model has them, too."""

from typing import Any

import casadi as ca
import pytest
from helpers import reviewed

import fpirhc as fp

LAG = 0.02  # s
LAW = fp.Exponential(rate=6.0)
MAP = fp.Affine(gain=-0.4)


def plant(wrong: float = 1.5) -> fp.Plant:
    return fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": fp.Parameter(wrong, 1.0, "kg")},
        response=lambda q, v, u, p: {"y": (u.u - 4 * q.y) / p.m},
    )


def task(**changes) -> fp.Problem:
    usual: dict[str, Any] = {
        "plant": plant(),
        "reference": fp.Trajectory(lambda t: {"y": 0.3 * ca.sin(2 * t)}),
        "start": {"y": 0.0, "y'": 0.6},
        "period": 2e-3,
        "duration": 4.0,
        "measure_from": 1.0,
    }
    return fp.Problem(**(usual | changes))


def asked(problem: fp.Problem, deformation) -> Any:
    return reviewed.answers(problem, fp.ComputedTorque(LAW, deformation))["model"]


def lagging() -> fp.Reality:
    """A mass on a spring behind an actuator: tau du/dt = u_c - u."""
    behind = fp.Plant(
        coordinates={"y": "m", "acting": "N"},
        inputs={"u": "N"},
        order={"y": 2, "acting": 1},
        parameters={"m": fp.Parameter(1.5, 1.0, "kg")},
        response=lambda q, v, u, p: {"y": (q.acting - 4 * q.y) / p.m, "acting": (u.u - q.acting) / LAG},
    )
    return fp.Reality(behind, start={"y": 0.0, "y'": 0.6, "acting": 0.0})


@pytest.mark.parametrize("reality", [None, lagging()])
def test_a_believed_lag_is_a_part_of_the_right_model(reality):
    """Beside a plant without lag and beside a real one: it leaves a right model alone, and no form is advised."""
    answer = asked(task(reality=reality), fp.ModelReferenced(MAP, lag=LAG))
    assert answer.verdict == "yes", answer
    assert answer.numbers["error_with"] == pytest.approx(answer.numbers["error_without"], rel=1e-3)
    assert answer.change == ""


def test_a_believed_dead_time_is_a_part_of_the_right_model_too():
    """Where the problem states none; a dead time that it states is a fact."""
    assert asked(task(), fp.ModelReferenced(MAP, cycles=5.0, measurement=2.0)).verdict == "yes"
