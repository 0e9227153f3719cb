"""A review's question about the discretisation of the horizon: poles of a stage against poles of the plant."""

from __future__ import annotations

from dataclasses import replace

import fpirhc as fp
from fpirhc.controllers.base import Controller

PLANT = fp.Plant(
    coordinates={"x": "m"},
    inputs={"u": "m/s"},
    order=1,
    response=lambda q, u, p: {"x": -p.rate * q.x + u.u},
    parameters={"rate": fp.Parameter(40.0, 40.0, "1/s")},
)
HORIZON = fp.Horizon(stages=10, step=0.1)
PROBLEM = fp.Problem(
    plant=PLANT,
    reference=fp.Trajectory(lambda t: {"x": 0.1 * t}),
    start={"x": 0.0},
    period=0.1,
    duration=1.0,
    limits=fp.Limits(inputs={"u": (-10.0, 10.0)}),
    horizon=HORIZON,
    cost=fp.Quadratic(states={"x": 1.0}, effort={"u": 0.1}),
)


STIFF = fp.RungeKutta4()


def answers(problem: fp.Problem, controller: Controller) -> dict[str, fp.Answer]:
    """All answers by question."""
    return {a.question: a for a in fp.review(problem, {"it": controller}, mismatch=0.0, seed=0).answers}


def test_advice_on_a_mode_that_no_sub_step_follows_is_a_sentence():
    """A mode of 1e4 1/s under a stage of 0.1 s: the implicit method alone."""
    fast = replace(PLANT, parameters={"rate": fp.Parameter(1e4, 1e4, "1/s")})
    problem = replace(PROBLEM, plant=fast, integrator=fp.Cvodes(), horizon=replace(HORIZON, discretisation=STIFF))
    one = answers(problem, fp.ComputedTorque(fp.Exponential(1.0)))
    assert one["Does the discretisation of the horizon follow the plant?"].change == (
        "Use Horizon(discretisation=RadauIIA()); no number of explicit sub-steps up to 64 times that in use follows every mode."
    )
