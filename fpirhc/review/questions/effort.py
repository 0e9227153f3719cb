"""Does the cost leave the effort free that the plant needs? A weight of the absolute effort does not, where the model is wrong."""

from __future__ import annotations

import numpy as np

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case, ControllerQuestion

TEXT = "Does the cost leave the effort free that the plant needs?"
FACT = (
    "its cost weighs the absolute effort, so the optimum of the wrong model trades tracking against a wrong effort and adaptation "
    "realises that plan faithfully"
)
CHANGE = "Weigh the deviation from the model's feedforward, or the input's rate."


def leaves_effort_free(case: Case) -> Answer | None:
    """Return whether a plan weighs the absolute effort; None without a plan, and where the model is right."""
    planner = case.controller.planner
    cost = None if planner is None else planner.cost or case.problem.cost
    right = case.grid.real is None and np.array_equal(case.believed, case.problem.plant.exact)
    if cost is None or right:
        return None
    if cost.weighs_effort:
        return Answer(TEXT, Verdict.UNKNOWN, FACT, CHANGE)
    return Answer(TEXT, Verdict.YES, "its cost weighs no absolute effort")


QUESTION = ControllerQuestion(leaves_effort_free, order=2)
