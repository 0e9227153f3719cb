"""Learners behind dead time and estimators, disturbances seen in the response, and estimates that act in every cycle."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from helpers.plants import linear
from helpers.plants import simulated as run

import fpirhc as fp

PERIOD = 0.01
TRACK = fp.ComputedTorque(fp.Exponential(rate=2.0))
LEARNED = {"k": fp.Uncertain(0.0, 10.0, 1.0), "b": fp.Uncertain(0.1, 5.0, 0.5)}
LEARNERS = {"RLS": fp.RecursiveLeastSquares(LEARNED, {"y": 0.1}, 5.0)}
LATE = {
    "input": fp.DeadTime(inputs={"u": 0.05}),
    "measurement": fp.DeadTime(measurement=0.05),
    "both": fp.DeadTime(inputs={"u": 0.03}, measurement=0.02),
}


def spring(**changes: Any) -> fp.Problem:
    """Y'' = b u - k y with wrong k and b, both of which are learned."""
    plant = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"k": fp.Parameter(2.0, 3.0, "1/s^2"), "b": fp.Parameter(1.5, 1.0, "1/kg")},
        response=lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y},
    )
    settings: dict[str, Any] = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {"y": 0.3 * ca.sin(2 * t) + 0.1 * ca.sin(5 * t)}),
        "start": {"y": 0.05},
        "period": PERIOD,
        "duration": 4.0,
        "limits": fp.Limits(inputs={"u": (-20.0, 20.0)}),
        "horizon": fp.Horizon(stages=10, step=10 * PERIOD),
        "cost": fp.Quadratic(states={"y": 1e2, "y'": 1.0}, deviation={"u": 0.01}),
    }
    return fp.Problem(**(settings | changes))


# Pairs


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("late", LATE)
def test_parameters_are_found_behind_dead_time(learner, late):
    """To 1e-3, where pairs that ignore the dead time leave errors a hundred times as large."""
    problem = spring(dead_time=LATE[late])
    errors = []
    for believed in (None, fp.DeadTime()):
        result = run(problem, fp.Estimating(TRACK, LEARNERS[learner], dead_time=believed))
        errors.append(np.abs(result["estimate"][-1] - [3.0, 1.0]).max())
        if believed is None:  # a late sample shows the start for so many cycles, and teaches nothing
            assert np.ptp(result["estimate"][: 1 + round(LATE[late].measurement / PERIOD)], axis=0).max() == 0
    assert errors[0] < 1e-3
    assert errors[1] > 100 * errors[0]


# The response in the filter


def test_the_gain_of_a_measured_response_is_that_of_the_stationary_filter():
    """A double integrator with y and y'' = b u + w measured: the Riccati equation written out by hand, solved by scipy."""
    problem = spring(plant=linear(1.0, 1.0))
    filter = fp.DisturbanceKalman({"y": 2.0}, {"y": 1e-3, "y''": 0.3}, noise={"y": 0.5})
    h = PERIOD
    a = np.array([[1, h, h**2 / 2], [0, 1, h], [0, 0, 1]])
    b, c = np.array([[h**2 / 2], [h], [0]]), np.array([[1.0, 0, 0], [0, 0, 1.0]])
    q, r = 0.5**2 * b @ b.T + np.diag([0, 0, 4 * h]), np.diag([1e-6, 0.09])
    p = scipy.linalg.solve_discrete_are(a.T, c.T, q, r)
    expected = p @ c.T @ np.linalg.inv(c @ p @ c.T + r)
    np.testing.assert_allclose(filter.gain(replace(problem, plant=filter.model(problem.plant))), expected, rtol=1e-7)


# Estimates that act in every cycle


def offset_free(at_once: bool, tracking: Any = None) -> fp.Estimating:
    plan = fp.RecedingHorizon(fp.FixedPointSolver(iterations=3, tolerance=1e-6), tracking=tracking)
    return fp.Estimating(plan, fp.DisturbanceKalman({"y": 20.0}, {"y": 1e-4, "y'": 1e-3}), at_once=at_once)


def test_a_new_estimate_changes_the_command_between_plans():
    """Y'' = b u + w: the command is the plan's input minus what w has changed since the plan, over b."""
    problem = spring(plant=linear(1.0, 0.8), disturbances={"y": fp.Formula(lambda t: ca.sin(2 * np.pi * 3.0 * t))})
    result = run(problem, offset_free(at_once=True))
    command, planned, w = result["command"][:, 0], result["planned"][:, 0], result["estimate"][:, 0]
    since = w - np.repeat(w[::10], 10)[: w.size]
    np.testing.assert_allclose(command, planned - since / 0.8, atol=1e-9)
    assert np.abs(since).max() > 0.1
    held = run(problem, offset_free(at_once=False))
    np.testing.assert_allclose(held["command"], held["planned"], atol=1e-9)
