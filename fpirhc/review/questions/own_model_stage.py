"""Does the discretisation follow a controller's own model? A controller with the exact parameters plans with other modes."""

from __future__ import annotations

import numpy as np

from fpirhc.review.answer import Answer
from fpirhc.review.discretisation import stage_follows
from fpirhc.review.planned import is_planned
from fpirhc.review.question import Case, ControllerQuestion

TEXT = "Does the discretisation of the horizon follow the controller's own model?"


def own_model_stage(case: Case) -> Answer | None:
    """Return how far the poles of one stage are from those of the controller's model; None where it is the problem's model."""
    approximate = case.problem.plant.approximate
    if not is_planned(case.controller) or np.array_equal(case.believed, approximate):
        return None
    return stage_follows(case.grid, case.believed, TEXT)


QUESTION = ControllerQuestion(ask=own_model_stage, order=20, adaptive=False)
