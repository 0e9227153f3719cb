"""The null test of a form that believes a lag or a dead time: its right model has them, too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import reviewed

import fpirhc as fp
from fpirhc.review.review import Answer
from fpirhc.simulation.model_as_plant import behind_actuators, with_believed_way

GALLERY = Path(__file__).parents[2] / "problems" / "gallery"
LAG = 0.02  # s
LAW = fp.Exponential(rate=6.0)
MAP = fp.Affine(gain=-0.4)


def plant(wrong: float = 1.5) -> fp.Plant:
    """A mass on a spring."""
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


def asked(problem: fp.Problem, deformation) -> Answer:
    return reviewed.answers(problem, fp.ComputedTorque(LAW, deformation))["model"]


def test_inputs_act_through_their_lags():
    """A step of 1 N on the mass alone: u_act = 1 - exp(-t / tau)."""
    lagging = behind_actuators(plant(1.0), (LAG,))
    assert lagging.coordinates == {"y": "m", "u_acting": "N"}
    problem = task(
        plant=plant(1.0),
        reality=fp.Reality(lagging, start={"u_acting": 0.0}),
        limits=fp.Limits(inputs={"u": (1.0, 1.0 + 1e-12)}),
    )
    run = fp.simulate(problem, fp.ComputedTorque(LAW), seed=0, compiled=False)
    expected = 1 - np.exp(-run.time / LAG)
    np.testing.assert_allclose(run["reality_state.u_acting"], expected, atol=1e-6)


def test_a_map_has_no_lag():
    """It has no time between two steps."""
    yearly = fp.load_problem(str(GALLERY / "fishery.py")).problem
    assert with_believed_way(yearly, fp.ModelReferenced(MAP, lag=1.0)) is yearly


@pytest.mark.parametrize("reality", [None, fp.Reality(behind_actuators(plant(1.0), (LAG,)), start={"u_acting": 0.0})])
def test_a_believed_lag_is_a_part_of_the_right_model(reality):
    """Beside a plant without lag and beside a real one: it leaves a right model alone, and no form is advised."""
    answer = asked(task(reality=reality), fp.ModelReferenced(MAP, lag=LAG))
    assert answer.verdict == "yes", answer
    assert answer.numbers["error_with"] == pytest.approx(answer.numbers["error_without"], rel=1e-3)
    assert answer.change == ""


def test_a_believed_dead_time_is_a_part_of_the_right_model_too():
    """Where the problem states none; a dead time that it states is a fact."""
    form = fp.ModelReferenced(MAP, cycles=5.0, measurement=2.0)
    believed = with_believed_way(task(), form)
    assert believed.dead_time.inputs == {"u": pytest.approx(0.01)}
    assert believed.dead_time.measurement == pytest.approx(0.004)
    late = task(dead_time=fp.DeadTime(inputs={"u": 0.02}))
    assert with_believed_way(late, form) is late
    assert with_believed_way(late, MAP) is late
    assert asked(task(), form).verdict == "yes"


def test_a_comparison_asks_the_same():
    adapting = fp.ComputedTorque(LAW, fp.ModelReferenced(MAP, lag=LAG))
    shipped = fp.load_problem("two_mass")
    real = fp.Reality(behind_actuators(plant(1.0), (LAG,)), start={"u_acting": 0.0})
    pair = {"CTC": fp.ComputedTorque(LAW), "CTC+FPI": adapting}
    made = replace(shipped, problem=task(reality=real, duration=2.0), controllers=pair, headline=("CTC", "CTC+FPI"))
    null = fp.compare(made, seed=0, compiled=False)["CTC+FPI"].null
    assert null.passes
    assert null.adapted["y"] == pytest.approx(null.without["y"], rel=1e-3)
