"""Comparisons of plants of others beside an integration that shares no line with the library's loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from foreign_plants import (
    PLANTS,
    ball_and_beam,
    blending,
    magnet,
    masses,
    planned_by_hand,
    plans,
    rms_by_hand,
    rocket,
    stocking,
    underwater,
)
from reviewed import answer, case

import fpirhc as fp
from fpirhc.errors import InvalidProblem
from fpirhc.review.question import Verdict
from fpirhc.review.questions.convergence import box_converges
from fpirhc.review.review import predict
from fpirhc.studies.comparison.changes import Outcome
from fpirhc.summary import written_out

QUICK = ("conical_tank", "stocking")
INVERTED = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in PLANTS if name != "ball_and_beam"
]


@pytest.mark.parametrize("name", INVERTED)
def test_errors_and_verdict_are_those_of_an_independent_integration(name):
    """Every number of the verdict's sentence is the integration's, in its digits; the sentence says what these numbers say."""
    one = PLANTS[name]()
    comparison = one.compared(name)
    plain, adaptive = rms_by_hand(one, adaptive=False), rms_by_hand(one, adaptive=True)
    for label, rms in (("CTC", plain), ("CTC+FPI", adaptive)):
        assert dict(comparison[label].metrics.rms_error) == pytest.approx(rms, rel=1e-4)
    assert comparison.outcome is Outcome.BETTER
    for quantity, least in adaptive.items():
        assert least < plain[quantity] / 5
        assert f"{quantity} from {written_out(plain[quantity])} to {written_out(least)}" in comparison.verdict[0]
    null = comparison.null
    assert null is not None
    assert not null.harmful


def test_an_output_whose_gain_vanishes_on_the_way_is_refused_with_place_and_time():
    with pytest.raises(
        InvalidProblem, match=r"the gain from torque to place vanishes .* at t = 0\.\d+ s .*choose another output"
    ):
        ball_and_beam()


@pytest.mark.parametrize(("plant", "grown"), [(rocket, "1.6 %"), (masses, "7.59 %")])
def test_zero_dynamics_that_hardly_grow_over_the_run_are_no_refusal(plant, grown):
    """The rocket's mass, and rounded matrices: the run cannot show the growth, and the comparison is good."""
    one = plant()
    zero = answer(one.problem, one.controllers["CTC"], "zero dynamics")
    assert zero.verdict is Verdict.UNKNOWN
    assert f"by {grown} over the run" in zero.evidence


@pytest.mark.slow
def test_plans_are_those_of_opti_in_closed_loop():
    """A wrong model, limits, and a plan in every cycle: the course is that of IPOPT's plans."""
    problem, controller = plans(underwater())
    errors = fp.simulate(problem, controller, seed=0, compiled=False)["error.x"]
    hand = planned_by_hand(underwater(), problem)
    assert np.abs(hand).max() > 0.1
    assert errors[: len(hand)] == pytest.approx(hand, abs=1e-6)


@pytest.mark.parametrize(("plant", "states"), [(blending, "V, x"), (stocking, "adults, young")])
def test_a_review_of_two_outputs_answers_no_question_with_no(plant, states):
    """Two inputs and two outputs, of a flow and of a map: states that are simulated are named, and a gain is recommended."""
    one = plant()
    answers = fp.review(one.problem, {"CTC+FPI": one.controllers["CTC+FPI"]}, mismatch=10.0, seed=0)
    every = (*answers.problem, *answers.controllers["CTC+FPI"])
    assert not [a.question for a in every if a.verdict is Verdict.NO]
    assert every[0].evidence.endswith(f"; {states} have no task and are simulated")
    [admissible] = [a for a in every if "gain admissible" in a.question]
    assert admissible.verdict is Verdict.YES
    assert admissible.numbers["recommended"] == pytest.approx(admissible.numbers["limit"] / 2, rel=1e-6)


def test_a_force_by_the_square_of_its_current_is_inverted():
    """Newton's method begins where the current has an effect, which it has not at zero."""
    plant = magnet().problem.plant
    current = float(plant.equations.inverse([0.05, 0.0], -1.0, plant.approximate))
    assert current == pytest.approx(np.sqrt((9.81 + 1.0) * 0.1 * 2 * 0.05 * 4 / 0.01), rel=1e-9)


def test_a_start_at_which_the_input_has_no_effect_is_no_error_inside():
    """The gain of the start is not known there, and so refuses nothing."""
    one = magnet()
    still = replace(
        one.problem, limits=fp.Limits(inputs={"current": (0.0, 12.0)}), input_before={}, duration=0.1, measure_from=0.0
    )
    comparison = replace(one, problem=still).compared("still")
    assert not comparison.skipped
    assert comparison["CTC+FPI"].run.stop is None


@pytest.mark.parametrize(
    ("plant", "question", "said", "change"),
    [
        (rocket, "Are the zero dynamics stable?", "by 1.6 % over the run", "Weigh the other states in the cost"),
        (
            masses,
            "Is the sampling fast enough for the tracking law?",
            "is multiplied by 1.00038 per cycle",
            "It is the mode of the zero dynamics",
        ),
        (
            masses,
            "Is the horizon long enough?",
            "diverges at 0.000759 1/s",
            "A longer horizon plans the same: weigh what div",
        ),
    ],
)
def test_a_plan_is_not_refused_for_growth_that_the_run_does_not_show(plant, question, said, change):
    """Nor is a longer horizon advised where it changes nothing."""
    one = plant()
    [output], period = one.problem.plant.outputs, one.problem.period * (1 if one.problem.plant.step else 5)
    problem = replace(
        one.problem, horizon=fp.Horizon(stages=15, step=period), cost=fp.Quadratic(outputs={output: 100.0})
    )
    plan = fp.RecedingHorizon(fp.FixedPoint(iterations=5, tolerance=1e-3))
    one_answer = answer(problem, plan, question)
    assert one_answer.verdict is Verdict.CAUTION
    assert said in one_answer.evidence
    assert one_answer.change.startswith(change)


@pytest.mark.parametrize("plant", [rocket, masses])
def test_growth_that_no_gain_changes_is_not_blamed_on_the_gain(plant):
    """The zero dynamics are the slowest mode: neither the tracking rate nor the gain is advised to change."""
    one = plant()
    adaptive = one.controllers["CTC+FPI"]
    boxed = case(one.problem, adaptive, mismatch=10.0)
    verdicts = Verdict.UNKNOWN, Verdict.CAUTION  # the box has its shares
    for said, verdict in zip((predict(one.problem, adaptive), box_converges(boxed)), verdicts, strict=True):
        assert said.verdict is verdict
        assert said.change.startswith("The slowest mode is that of the zero dynamics, which no gain changes")


@pytest.mark.parametrize("plant", [magnet, rocket, masses])
def test_a_gain_is_recommended_beside_modes_that_no_gain_changes(plant):
    """Neutral modes, and zero dynamics that the run does not show, set no limit; a run speaks for the named gain."""
    one = plant()
    admissible = answer(one.problem, one.controllers["CTC+FPI"], "gain admissible", mismatch=10.0)
    advice = admissible.numbers["recommended"]
    assert advice < -0.5
    law = one.controllers["CTC"]
    without, recommended = (
        fp.measure(one.problem, fp.simulate(one.problem, c, seed=0, compiled=False)).rms_error
        for c in (law, law.with_deformation(fp.ModelReferenced(fp.Affine(gain=advice))))
    )
    assert all(recommended[name] < without[name] / 4 for name in without)
