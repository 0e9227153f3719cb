"""Where a review knows less than a run, a run decides, and beside a reality its latency counts and not that of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.review.question import Answer
from fpirhc.review.questions.convergence import CONVERGES, RATES, ZERO_DYNAMICS
from fpirhc.review.questions.dead_time import UNSTATED
from fpirhc.review.questions.gain import GAIN
from fpirhc.review.questions.margins import MARGINS


def answers(problem: str, controller: str) -> dict[str, Answer]:
    """Of a controller of a shipped problem, by question."""
    task = fp.load_problem(problem)
    chosen = {controller: task.controllers[controller]}
    found = fp.review(task.problem, chosen, mismatch=0.0, seed=0).controllers[controller]
    return {one.question: one for one in found}


@pytest.fixture(scope="module")
def of_the_ball() -> dict[str, Answer]:
    return answers("ball_on_plate", "RHC+FPI")


@pytest.mark.slow
def test_a_gain_that_helps_is_admissible_though_the_recommended_one_does_harm(of_the_ball):
    """Half of the limit of its model, which has no servos, is a hundred times the gain in use, with which nine tenths are gone."""
    one = of_the_ball[GAIN]
    assert (one.verdict, one.change) == ("yes", "")
    assert one.numbers["with"] < 0.2 * one.numbers["without"]
    assert "no gain is recommended" in one.evidence
    assert np.isnan(one.numbers["recommended"])


def test_a_latency_is_borne_as_the_reality_bears_it(of_the_ball):
    """The servos of the table leave one cycle where the model has three, and with three cycles a run swings."""
    one = of_the_ball[UNSTATED]
    assert (one.verdict, one.numbers["borne"]) == ("caution", 1.0)
    assert one.change.startswith("No lower gain bears them; ")
    task, errors = fp.load_problem("ball_on_plate"), list[float]()
    for cycles in (0, 3):
        late = fp.DeadTime(inputs=dict.fromkeys(("across", "along"), cycles * task.problem.period))
        problem = replace(task.problem, dead_time=late, duration=8.0)
        run = fp.simulate(problem, task.controllers["RHC+FPI"], seed=0, compiled=False)
        errors.append(fp.measure(problem, run).rms_error["x"])
    assert errors[1] > 20 * errors[0]


def test_a_map_that_tunes_itself_is_judged_by_runs():
    """Its linear loop is that of the first cycle."""
    one = answers("noisy_motor", "RHC+FPI, tuned")[CONVERGES]
    assert (one.verdict, one.change) == ("yes", "")
    assert one.numbers["with"] < 0.3 * one.numbers["without"]
    assert one.numbers["radius"] < 1
    assert "Tuned changes its map on line" in one.evidence


def test_a_loop_with_doubts_is_judged_by_runs():
    """It converges, but the first doses are at their limit; in the run five sixths of the error are gone."""
    one = answers("tumour_portions", "RHC+FPI, model-referenced")[CONVERGES]
    assert (one.verdict, one.change) == ("yes", "")
    assert one.numbers["with"] < 0.3 * one.numbers["without"]
    assert "is answered no" in one.evidence


def test_what_feeds_nothing_back_is_asked_neither_for_rate_nor_for_margins():
    """A queue behind a static map is a caution: it neither grows nor decays by itself."""
    static = answers("freeway", "static map")
    assert not {RATES, MARGINS} & set(static)
    assert static[ZERO_DYNAMICS].verdict == "caution"
