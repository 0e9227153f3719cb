"""What a review says before a run, and whether it is right."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from reviewed import about, answers, mass, torque

import fpirhc as fp


def test_a_good_problem_is_ready():
    """Every answer about a mild mismatch is yes, in the form that suits the problem and in the plain one, whose run is as good."""
    problem, plain = mass(limits=fp.Limits(inputs={"u": (-20.0, 20.0)})), torque()
    answers_by_question = answers(problem, replace(plain, deformation=fp.ModelReferenced(plain.deformation)))
    assert {a.verdict for a in answers_by_question.values()} == {"yes"}
    assert all(not a.change for a in answers_by_question.values())
    assert {a.verdict for a in answers(problem, plain).values()} == {"yes"}


def test_wrong_sign_is_found_before_the_run():
    answers_by_question = answers(mass(), torque(gain=0.5))
    assert about(answers_by_question, "Does the deformation converge").verdict == "no"
    gain = about(answers_by_question, "gain admissible")
    assert gain.verdict == "no"
    assert (
        -1 / 0.396737 / 1.5 < gain.numbers["recommended"] < 0
    )  # J from 1 to 1.5 over the box; the whole loop bears less
    assert gain.numbers["recommended"] == pytest.approx(0.5 * gain.numbers["limit"])


def test_values_that_make_no_sense_are_refused():
    """Percentages outside 0 to 100."""
    for wrong in (-1.0, 100.0, math.nan):
        with pytest.raises(ValueError, match="mismatch"):
            fp.review(mass(), {}, mismatch=wrong, seed=0)


# They differentiate plans of 10 ms and more; the journey below reviews dead time, and others of their kind are quicker.


def test_slots_are_judged_by_their_schedule():
    """Crane: the published radius; a controller that does not fit is a no with its reason."""
    task = fp.load_problem("crane_slots")
    controller: Any = task.controllers["slots+FPI"]
    answers_by_question = answers(task.problem, controller)
    assert about(answers_by_question, "schedule").numbers["floquet_radius"] == pytest.approx(0.0485, abs=1e-3)
    wrong = replace(controller, slots=(replace(controller.slots[0], order=3), controller.slots[1]))
    assert about(answers(task.problem, wrong), "fit the problem").verdict == "no"
