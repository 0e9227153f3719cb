"""The cause in a verdict is the cause in a review: one function decides, both print it."""

from __future__ import annotations

from dataclasses import replace
from html import unescape
from typing import Any

import pytest
from reviewed import answer
from test_verdict import case
from test_verdict_sentences import EFFORT, entry, first, no_difference

import fpirhc as fp
from fpirhc.report.html import render
from fpirhc.review.questions.gain import recommended_for, reviewed_gain
from fpirhc.studies.comparison.changes import Outcome

SLOW = "Its gain is too small: the effective gain is 0.1. Use gain = -3 or more."
GENTLE = "RHC+FPI, gentle"


@pytest.fixture(scope="module")
def daily():
    """The tumour with one dose a day, whose gentle gain is worse than none."""
    return fp.load_problem("problems/gallery/tumour_daily.py")


def test_a_gentle_gain_is_blamed_and_not_the_limits_that_it_swings_between(daily):
    """Doses go from zero to the largest, because the gain is too small: the verdict says what the review says."""
    pair = {name: daily.controllers[name] for name in ("RHC", GENTLE)}
    task = replace(daily, controllers=pair, headline=("RHC", GENTLE))
    comparison = fp.compare(task, seed=0, compiled=False)
    slow = answer(daily.problem, pair[GENTLE], "keep up")
    assert comparison.outcome is Outcome.WORSE
    assert f" Its gain is too small: {slow.evidence}. {slow.change}" in comparison.verdict[0]
    assert "stands at a limit" not in comparison.verdict[0]
    iteration = comparison[GENTLE].contraction
    assert iteration is not None
    assert iteration.report.within_sector  # which says nothing of the loop, so that the page does not leave it at that
    said = f"{iteration.report.text} This is of the iteration by itself; what the whole loop did is in the verdict."
    assert said in unescape(render(comparison))
    assert reviewed_gain(daily.problem, daily.controllers["RHC+FPI"], grows=False) == ""
    assert reviewed_gain(daily.problem, daily.controllers["RHC"], grows=True) == ""


def test_a_gain_that_is_too_large_is_told_with_the_recommended_one():
    """The verdict, the review and the refusal name one number, 1 / 1.6 times half of 2; a note beside the row says it no more."""
    task = case(fp.BeyondLimit(fp.Affine(gain=-2.9)))
    comparison = fp.compare(task, seed=0, compiled=False)
    advice: Any = recommended_for(task.problem, task.controllers["adaptive"])
    assert comparison.verdict[0].endswith(f"(predicted factor 1.32). Its gain is too large: {advice.text}.")
    assert advice.value == pytest.approx(-2 / 1.6, rel=0.01)
    assert not [note for note in comparison["adaptive"].notes if "gain" in note]


def test_causes_stand_in_the_order_in_which_they_act():
    """The cost before the plans, the plans before the gain; limits are an effect of the gain."""
    often = {"at_limit": {"": 0.9}, "status": {"NOT_CONVERGED": 0.0}}
    assert no_difference(facts={"reviewed_gain": SLOW}, measured=often) == f" {SLOW}"
    assert no_difference(facts={"reviewed_gain": SLOW}, settings={"weighs_effort": True}) == f"{EFFORT} {SLOW}"
    grows = " Its iteration is no contraction (predicted factor 1.5)."
    assert no_difference(factor=1.5) == f"{grows} Lower the gain."
    assert no_difference(facts={"reviewed_gain": "Its gain: 1."}, factor=1.5) == f"{grows} Its gain: 1."


def test_a_weight_of_the_effort_is_named_whether_adaptation_helps_or_not():
    """A smaller error of a plan that trades tracking against a wrong effort stays a success, with its reason to look."""
    better = first(entry("RHC"), entry("FPI", "RHC", errors={"y": 0.5}, settings={"weighs_effort": True}))
    assert better.outcome is Outcome.BETTER
    assert better.text == f"FPI lowers the rms error of y from 1 to 0.5 m (2 times less).{EFFORT}"


def test_a_review_names_the_weight_of_the_effort_in_the_same_words():
    """two_mass has a pair with such a cost on purpose."""
    task = fp.load_problem("two_mass")
    for name, verdict in (("RHC+FPI, absolute effort", "caution"), ("RHC+FPI", "yes")):
        one = answer(task.problem, task.controllers[name], "effort free")
        assert one.verdict == verdict
        if verdict == "caution":
            assert f" I{one.evidence[1:]}. {one.change}" == EFFORT


@pytest.mark.parametrize(("name", "missed"), [("leaking_tanks", "leak"), ("chain_of_masses", "m")])
def test_a_review_names_a_wrong_parameter_that_is_in_no_controlled_response(name, missed):
    task = fp.load_problem(name)
    adaptive = next(c for c in task.controllers.values() if c.deformation.adapts)
    evidence = answer(task.problem, adaptive, "reach the wrong").evidence
    assert evidence.endswith(f"the response does not depend on {missed}")


def test_it_is_a_cause_on_every_pair_that_it_spoils():
    task = fp.load_problem("leaking_tanks")
    adaptive = next(n for n, c in task.controllers.items() if c.deformation.adapts)
    comparison = fp.compare(task, seed=0, controllers=["RHC", adaptive], compiled=False)
    words = " The controlled response does not depend on leak, which the model has wrong and adaptation cannot correct."
    assert words in comparison.verdict[0]
