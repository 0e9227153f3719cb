"""Plans that start where the model has the measured outputs keep the limits of the measured state."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.plants import simulated

import fpirhc as fp

ADAPTIVE = fp.ModelReferenced(fp.Affine(-1.6))
SOLVED = fp.FixedPointSolver(iterations=20, tolerance=1e-4)  # V


def servo(believed: float, **settings: Any) -> fp.Problem:
    """A servo, angle' = a speed, speed' = 4 b (u - speed): a move at a speed of at most 1 rad/s; the model has a and b wrong."""
    parameters = {"a": fp.Parameter(believed, 1.0, "1"), "b": fp.Parameter(1.3, 1.0, "1/s")}
    rates = lambda x, u, p: {"angle": p.a * x.speed, "speed": 4 * p.b * (u.u - x.speed)}  # noqa: E731 -- of the states
    shown = {"outputs": {"y": fp.Output("rad", lambda x, p: x.angle)}, "rates": rates, "parameters": parameters}
    plant = fp.Plant.of_states(states={"angle": "rad", "speed": "rad/s"}, inputs={"u": "V"}, **shown)
    limits: dict[str, Any] = {"inputs": {"u": (-3.0, 3.0)}, "states": {"speed": (-1.0, 1.0)}, **settings}
    planned: dict[str, Any] = {"cost": fp.Quadratic(outputs={"y": 1.0}, rate={"u": 1e-4}), "period": 0.02}
    planned |= {"horizon": fp.Horizon(stages=20, step=0.1), "duration": 4.0, "limits": fp.Limits(**limits)}
    moved = fp.Trajectory(lambda t: {"y": 2 / (1 + ca.exp(-4 * (t - 2)))})
    return fp.Problem(plant, moved, {"angle": 0.0, "speed": 0.0}, **planned)


def fastest(run: fp.Run) -> float:
    return float(np.abs(run["state.speed"]).max())


@pytest.mark.parametrize(("believed", "most"), [(0.7, 1.02), (1.4, 1.2)])
def test_limits_of_states_behind_outputs_hold_for_the_measured_state(believed: float, most: float) -> None:
    """At x* the model's speed is a / a^ times the measured one: bound there, it may be 1.4 rad/s, or not more than .7."""
    problem, controller = servo(believed), fp.RecedingHorizon(SOLVED, ADAPTIVE)
    run = simulated(problem, controller)
    assert 0.98 < fastest(run) < most
    assert run["status"].max() == 0
    free = simulated(servo(believed, states={}), controller)
    assert fastest(free) > 1.5


def test_behind_an_estimator_a_right_model_is_left_alone_by_plans_from_the_given_state() -> None:
    """And not by those from the estimated outputs, of which a note says so."""
    problem = replace(servo(1.3, states={}), sensing=fp.Sensing(estimator=fp.SavitzkyGolay(window=15, degree=2)))
    right = problem.with_exact(problem.plant.approximate)
    plain, usual = fp.RecedingHorizon(SOLVED), fp.RecedingHorizon(SOLVED, ADAPTIVE)
    given = fp.RecedingHorizon(SOLVED, ADAPTIVE, consistent=False)
    errors = [fp.measure(right, simulated(right, one)).rms_error["y"] for one in (plain, given, usual)]
    assert errors[1] == pytest.approx(errors[0], rel=1e-6)
    assert errors[2] > 1.5 * errors[0]
    assert [len(one.notes(problem)) for one in (plain, given, usual)] == [0, 0, 1]
    assert "consistent=False" in usual.notes(problem)[0]
    assert usual.notes(replace(problem, sensing=fp.Sensing())) == ()
