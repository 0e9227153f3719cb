"""At rest on the reference the first plan is the feedforward: the optimum of cost zero, wherever the set-point is."""

from collections.abc import Callable
from dataclasses import dataclass
from math import sin, sqrt
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import posed

MANY = 12  # set-points of every plant


@dataclass(frozen=True)
class Rest:
    """A plant with one coordinate, where it may rest, and the input that holds it there."""

    response: Callable[..., Any]
    order: int
    limits: tuple[float, float]
    places: tuple[float, float]
    needs: Callable[[float], float]


def levitated(q, v, u, p):
    return 9.81 - p.c * (u.u / q.x) ** 2


PLANTS = {
    # Squares of the input: a plan of zeros is at a place where no input does anything.
    "ball under a magnet": Rest(levitated, 2, (0.0, 3.0), (6e-3, 20e-3), lambda x: x * sqrt(9.81 / 1.7e-3)),
    "heater": Rest(
        lambda q, u, p: p.c * u.u**2 - 0.3 * q.x, 1, (0.0, 20.0), (1.0, 60.0), lambda x: sqrt(0.3 * x / 0.1)
    ),
    "fan under a ball": Rest(
        lambda q, v, u, p: p.c * u.u**2 / (1 + q.x) - 9.81 - 0.2 * v.x,
        2,
        (0.0, 60.0),
        (0.1, 1.5),
        lambda x: sqrt(9.81 * (1 + x) / 0.02),
    ),
    "tank": Rest(
        lambda q, u, p: p.c * u.u - 0.4 * ca.sqrt(q.x), 1, (0.0, 5.0), (0.05, 4.0), lambda x: 0.4 * sqrt(x) / 0.7
    ),
    "pendulum": Rest(
        lambda q, v, u, p: p.c * u.u - 9.81 * ca.sin(q.x) - 0.1 * v.x,
        2,
        (-30.0, 30.0),
        (-3.1, 3.1),
        lambda x: 4.905 * sin(x),
    ),
}
CONSTANTS = {"ball under a magnet": 1.7e-3, "heater": 0.1, "fan under a ball": 0.02, "tank": 0.7, "pendulum": 2.0}
OPTIMISERS = {"default": fp.FixedPointSolver(), "one iteration": fp.FixedPointSolver(iterations=1, tolerance=1e-2)}


def problem_of(name: str, at: float) -> fp.Problem:
    one, constant = PLANTS[name], CONSTANTS[name]
    size = one.places[1] - one.places[0]
    plant = fp.Plant(
        coordinates={"x": "m"},
        inputs={"u": "A"},
        order=one.order,
        response=lambda *given: {"x": one.response(*given)},
        parameters={"c": fp.Parameter(constant, 0.9 * constant, "1")},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"x": at + 0 * t}),
        start={"x": at},
        period=1e-3,
        duration=0.1,
        limits=fp.Limits(inputs={"u": one.limits}),
        horizon=fp.Horizon(stages=20, step=5e-3),
        cost=fp.Quadratic(states={"x": 100 / size**2}, deviation={"u": 1 / (one.limits[1] - one.limits[0]) ** 2}),
    )


@pytest.mark.parametrize("optimiser", OPTIMISERS.values(), ids=OPTIMISERS)
@pytest.mark.parametrize("name", PLANTS)
def test_the_first_command_of_a_plan_at_rest_is_the_feedforward(name, optimiser):
    """At a dozen set-points, to 1e-6 of the range, with status OK."""
    one = PLANTS[name]
    problem = problem_of(name, sum(one.places) / 2)
    ocp, _, table = posed(problem)
    places, needs = ocp.data.slice("reference"), ocp.data.slice("feedforward")
    wrong = []
    for at in np.random.default_rng(1).uniform(*one.places, MANY):
        data, needed = table.copy(), one.needs(at)
        data[places.start], data[needs] = at, needed
        state = np.array([at, 0.0])[: one.order]
        plan = fp.solve(ocp, optimiser, state, data)
        off = abs(plan.inputs[0, 0] - needed) / (one.limits[1] - one.limits[0])
        if off > 1e-6 or plan.status != fp.Status.OK:
            wrong.append((at, off, plan.status))
    assert wrong == []


@pytest.mark.parametrize("gap", [8e-3, 9e-3 - 1e-9, 9e-3, 9e-3 + 1e-9, 9.00001e-3, 12e-3, 14.75e-3])
@pytest.mark.parametrize("iterations", [None, 1])
def test_a_loop_begins_with_the_feedforward(gap, iterations):
    """By the controller itself, whatever its iterations: a ball held at 9 mm fell with one, and at 9.00001 mm it did not."""
    optimiser = fp.FixedPointSolver(iterations=iterations, tolerance=None if iterations is None else 1e-2)
    problem = problem_of("ball under a magnet", gap)
    stepper = fp.Stepper(problem, fp.RecedingHorizon(optimiser), compiled=False)
    command, _ = stepper.step(0.0, problem.start_state, np.zeros(1), stepper.start())
    assert command[0] == pytest.approx(PLANTS["ball under a magnet"].needs(gap), abs=3e-6)
