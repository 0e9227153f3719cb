"""A review's question about the discretisation of the horizon: poles of a stage against poles of the plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.review.grid import review_grid
from fpirhc.review.question import Verdict
from fpirhc.review.questions.integration import discretisation_follows

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


@pytest.mark.parametrize(
    ("method", "verdict", "pole"),
    [
        (fp.RungeKutta4(), Verdict.NO, 1 - 4 + 8 - 64 / 6 + 256 / 24),
        (fp.Euler(), Verdict.NO, 3.0),
        (fp.RungeKutta4(8), Verdict.YES, np.exp(-4)),
        (fp.ImplicitMidpoint(), Verdict.CAUTION, 1 / 3),
        (fp.RadauIIA(4), Verdict.YES, np.exp(-4)),
    ],
)
def test_poles_of_a_stage(method, verdict, pole):
    """Lambda h = -4: the stability functions of the methods, and what follows from them."""
    problem = replace(PROBLEM, horizon=replace(HORIZON, discretisation=method))
    answer = discretisation_follows(review_grid(problem, 0.0, 0))
    assert answer is not None
    assert answer.verdict == verdict
    assert answer.numbers["fastest_mode"] == pytest.approx(40.0)
    assert answer.numbers["largest_pole"] == pytest.approx(abs(pole), abs=2e-3)


def test_a_stage_that_grows_beyond_every_number_is_a_no():
    """The plan cannot be rolled out; the review says so, and which discretisation can."""
    plant = replace(PLANT, parameters={"rate": fp.Parameter(1e40, 1e40, "1/s")})
    problem = replace(PROBLEM, plant=plant, horizon=replace(HORIZON, discretisation=fp.RungeKutta4(8)))
    answer = discretisation_follows(review_grid(problem, 0.0, 0))
    assert answer is not None
    assert answer.verdict == Verdict.NO
    assert "Use Horizon(discretisation=RadauIIA())" in answer.change
    assert answers(problem, fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3)))


def test_a_problem_without_a_horizon_is_not_asked():
    assert discretisation_follows(review_grid(replace(PROBLEM, horizon=None, cost=None), 0.0, 0)) is None


STIFF = fp.RungeKutta4()


def answers(problem: fp.Problem, controller: Controller) -> dict[str, fp.Answer]:
    """All answers by question."""
    return {a.question: a for a in fp.review(problem, {"it": controller}, mismatch=0.0, seed=0).answers}


def test_the_named_number_of_sub_steps_is_enough_and_half_of_it_is_not():
    """Lambda h = -4: the advice is tried, in the horizon and in the plant."""
    stiff = replace(PROBLEM, integrator=STIFF, horizon=replace(HORIZON, discretisation=STIFF))
    every = answers(stiff, fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3)))
    for words, field in (("of the horizon follow the plant", "discretisation"), ("follow the simulated", "integrator")):
        [one] = [a for q, a in every.items() if words in q]
        assert one.verdict == Verdict.NO
        count = int(one.change.partition(f"{field}=RungeKutta4(substeps=")[2].partition(")")[0])
        for tried, verdict in ((count, {Verdict.YES}), (count // 2, {Verdict.NO, Verdict.CAUTION})):
            method = fp.RungeKutta4(tried)
            horizon = replace(HORIZON, discretisation=method)
            mended = answers(
                replace(PROBLEM, integrator=method, horizon=horizon), fp.ComputedTorque(fp.Exponential(1.0))
            )
            [again] = [a for q, a in mended.items() if words in q]
            assert again.verdict in verdict


def test_a_stiff_discretisation_is_not_the_fault_of_the_rate():
    """The loop of a stable plant that its own discretisation makes unstable: sub-steps, and no lower rate."""
    stiff = replace(PROBLEM, integrator=fp.RungeKutta4(8), horizon=replace(HORIZON, discretisation=STIFF))
    adaptive = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3), fp.Sigmoid(gain=-0.5, scale=10.0))
    every = answers(stiff, adaptive)
    for words, verdicts in (
        ("sampling fast enough", {Verdict.NO}),
        ("deformation converge", {Verdict.NO, Verdict.UNKNOWN}),
    ):
        [one] = [a for q, a in every.items() if words in q]
        assert one.verdict in verdicts
        assert "substeps" in one.change
        assert "ower" not in one.change


def test_the_discretisation_is_the_cause_before_the_horizon():
    """A stage that grows by itself makes the plan diverge: no longer horizon is advised, and the cause stands first."""
    stiff = replace(PROBLEM, integrator=fp.RungeKutta4(8), horizon=replace(HORIZON, discretisation=STIFF))
    every = answers(stiff, fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3)))
    names = list(every)
    long_enough, follows = "Is the horizon long enough?", "Does the discretisation of the horizon follow the plant?"
    assert names.index(follows) < names.index(long_enough)
    assert every[long_enough].verdict == Verdict.NO
    assert every[long_enough].change == f"Its discretisation grows. {every[follows].change}"
    assert every[follows].change.startswith("Use Horizon(discretisation=RungeKutta4(substeps=")


def test_advice_on_a_mode_that_no_sub_step_follows_is_a_sentence():
    """A mode of 1e4 1/s under a stage of 0.1 s: the implicit method alone."""
    fast = replace(PLANT, parameters={"rate": fp.Parameter(1e4, 1e4, "1/s")})
    problem = replace(PROBLEM, plant=fast, integrator=fp.Cvodes(), horizon=replace(HORIZON, discretisation=STIFF))
    one = answers(problem, fp.ComputedTorque(fp.Exponential(1.0)))
    assert one["Does the discretisation of the horizon follow the plant?"].change == (
        "Use Horizon(discretisation=RadauIIA()); no number of explicit sub-steps up to 64 times that in use follows every mode."
    )


def test_a_controller_with_the_exact_model_has_a_discretisation_of_its_own():
    """The model is slow and the plant is fast: the exact model's plan is asked about by itself."""
    slow = replace(PLANT, parameters={"rate": fp.Parameter(4.0, 40.0, "1/s")})
    problem = replace(PROBLEM, plant=slow, integrator=fp.RungeKutta4(8))
    plain = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3))
    words = "controller's own model"
    assert not [q for q in answers(problem, plain) if words in q]
    [one] = [a for q, a in answers(problem, fp.ExactModel(plain)).items() if words in q]
    assert one.verdict == Verdict.NO
    assert one.numbers["fastest_mode"] == pytest.approx(40.0)
