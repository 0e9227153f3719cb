"""The input before the first cycle is a setting of the problem."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.errors import InvalidProblem

MASS, PERIOD = 2.0, 1e-2
PLANT = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={"m": fp.Parameter(MASS, MASS, "kg")},
    response=lambda q, v, u, p: {"y": u.u / p.m},
)
COST = fp.Quadratic(states={"y": 1.0}, effort={"u": 1e-3})
PROBLEM = fp.Problem(
    plant=PLANT,
    reference=fp.Trajectory(lambda t: {"y": 1.0 + 0.0 * ca.sin(t)}),
    start={"y": 1.0},
    period=PERIOD,
    duration=0.2,
    horizon=fp.Horizon(stages=5, step=PERIOD),
    cost=COST,
)
COMPUTED = fp.ComputedTorque(fp.Exponential(rate=6.0))


def planned(problem: fp.Problem, optimiser: fp.Ipopt | fp.FixedPointSolver) -> float:
    """The first planned input."""
    run = fp.simulate(replace(problem, duration=PERIOD), fp.RecedingHorizon(optimiser), seed=0, compiled=False)
    return float(run["command.u"][0])


def test_it_is_zero_or_the_nearest_limit_unless_it_is_given():
    for limits, given, expected in (
        ({}, {}, 0.0),
        ({"u": (2.0, 9.0)}, {}, 2.0),
        ({"u": (-9.0, -3.0)}, {}, -3.0),
        ({"u": (2.0, 9.0)}, {"u": 5.0}, 5.0),
    ):
        problem = replace(PROBLEM, limits=fp.Limits(inputs=limits), input_before=given)
        assert problem.inputs_before.tolist() == [expected]


@pytest.mark.parametrize(
    ("before", "message"),
    [
        ({"w": 1.0}, "input_before: input 'w' is unknown"),
        ({"u": 99.0}, "'u' must be a finite number within its limits, got 99.0"),
        ({"u": float("inf")}, "finite"),
    ],
)
def test_mistakes_are_named(before, message):
    with pytest.raises(InvalidProblem, match=message):
        replace(PROBLEM, limits=fp.Limits(inputs={"u": (-10.0, 10.0)}), input_before=before)


def test_the_first_weight_of_a_rate_is_counted_from_it():
    """With a rate weight that outweighs everything else the first input stays where the input was."""
    cost = replace(COST, rate={"u": 1e9})
    for before in (0.0, 3.0, -7.0):
        problem = replace(PROBLEM, cost=cost, input_before={"u": before})
        for optimiser in (fp.Ipopt(), fp.FixedPointSolver(iterations=3, tolerance=1e-3)):
            assert planned(problem, optimiser) == pytest.approx(before, abs=1e-4)


def test_it_acts_until_the_first_command_arrives():
    """A mass under a constant force: y = 1 + u t^2 / (2 m) for as long as no command has arrived, by hand."""
    waiting = 0.1
    late = replace(PROBLEM, dead_time=fp.DeadTime(inputs={"u": waiting}), input_before={"u": 3.0})
    run = fp.simulate(late, COMPUTED, seed=0, compiled=False)
    times = run.time[run.time <= waiting + PERIOD / 2]
    np.testing.assert_allclose(run["plant_state.y"][: times.size], 1 + 3.0 * times**2 / (2 * MASS), rtol=1e-12)
