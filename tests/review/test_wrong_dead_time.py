"""A review and a dead time that is not known exactly: the pairing, the margin in cycles, the box, dead times that differ."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from plants import heavy

import fpirhc as fp
from fpirhc.contraction.delayed import leaking_limit
from fpirhc.controllers.base import Controller
from fpirhc.deformation import Deformation
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_at

PERIOD, RATE = 1e-3, 6.0  # s, 1/s
MAP = fp.Affine(gain=-1.0)  # effective gain 0.5


def mass(cycles: int, **settings) -> fp.Problem:
    """A mass behind a dead time, the model's 1.3 times too large."""
    return fp.Problem(
        heavy(1.3, 1.0),
        fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(2 * t)}),
        start={"q": 0.0},
        period=PERIOD,
        duration=4.0,
        measure_from=2.0,
        dead_time=fp.DeadTime(inputs={"u": cycles * PERIOD}),
        **settings,
    )


def told(deformation: Deformation, cycles: int = 20) -> Controller:
    """The controller that believes in a dead time."""
    return fp.Predicted(fp.ComputedTorque(fp.Exponential(rate=RATE), deformation), inputs=cycles * PERIOD)


@pytest.mark.parametrize("cycles", [-5, -1, 1, 3])
def test_a_loop_with_another_dead_time_is_the_one_that_is_built_with_it(cycles):
    """A queue more, or commands that arrive sooner: the poles of the loop that is composed with that dead time."""
    controller = told(fp.Increment(MAP, cycles=20, uncertainty=5))
    [loop] = loops_at(review_grid(mass(20), 0.0, 0), controller, [10])
    [built] = loops_at(review_grid(mass(20 + cycles), 0.0, 0), controller, [10])
    assert loop.delayed([0], cycles).radius == pytest.approx(built.radius, abs=1e-7)


def test_plans_with_another_dead_time_are_those_that_are_built_with_it():
    """Over the ten cycles from plan to plan, with both inputs later and with one of them."""
    task = fp.load_problem("two_mass")
    controller, names = task.controllers["RHC"], tuple(task.problem.plant.inputs)
    [loop] = loops_at(review_grid(task.problem, 0.0, 0), controller, [10])
    for late in ([0, 1], [1]):
        times = fp.DeadTime(inputs={names[k]: 2 * task.problem.period for k in late})
        [built] = loops_at(review_grid(replace(task.problem, dead_time=times), 0.0, 0), controller, [10])
        assert loop.delayed(late, 2).radius == pytest.approx(built.radius, rel=1e-4)


def two_masses(second: int) -> fp.Problem:
    """Two masses that do not know each other, behind 5 and some other cycles."""
    plant = fp.Plant(
        coordinates={"a": "m", "b": "m"},
        inputs={"u": "N", "v": "N"},
        parameters={"m": fp.Parameter(1.3, 1.0, "kg")},
        response=lambda q, v, u, p: {"a": u.u / p.m, "b": u.v / p.m},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"a": 0.5 * ca.sin(2 * t), "b": 0.3 * ca.sin(t)}),
        start={"a": 0.0, "b": 0.0},
        period=PERIOD,
        duration=4.0,
        dead_time=fp.DeadTime(inputs={"u": 5 * PERIOD, "v": second * PERIOD}),
    )


@pytest.mark.parametrize(("late", "own", "width"), [(20, 20, 5), (21, 20, 5), (26, 20, 5), (4, 3, 1)])
def test_limit_of_a_mean_is_where_the_roots_leave_the_circle(late, own, width):
    """Against the roots of the polynomial, written down from the definition of the triangular mean."""
    limit = leaking_limit(np.append(np.zeros(late), [1.0, 0.0]), cycles=own, width=width)

    def radius(gain: float) -> float:
        polynomial = np.zeros(max(late, own + width) + 2)
        polynomial[0] = 1.0
        for j in range(-width, width + 1):
            polynomial[own + j + 1] -= (1 - abs(j) / (width + 1)) / (width + 1)
        polynomial[late + 1] += gain
        return float(np.abs(np.roots(polynomial)).max())

    assert radius(0.99 * limit) < 1 < radius(1.01 * limit)


def test_an_input_without_dead_time_beside_one_with():
    """Their queues have none and three entries: the run is that of the mass behind three cycles."""
    problem = replace(two_masses(3), dead_time=fp.DeadTime(inputs={"v": 3 * PERIOD}), duration=0.5)
    run = fp.simulate(problem, fp.ComputedTorque(fp.Exponential(rate=2.0)), seed=0, compiled=False)
    arriving = run["arriving"]
    np.testing.assert_allclose(arriving[3:, 1], run["command"][:-3, 1], rtol=1e-12)
    np.testing.assert_allclose(arriving[:, 0], run["command"][:, 0], rtol=1e-12)
