"""Does the loop with the reality converge where nothing adapts? Margins of the model's loop do not show what the model lacks."""

from __future__ import annotations

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.questions.reality_loop import TEXT
from fpirhc.review.real_pair import real_loops
from fpirhc.simulation.linearise.linear_loop import NEUTRAL


def plain_pair_converges(case: Case) -> Answer | None:
    """Return the largest pole of the real pair; None for adaptive controllers, and where there is no such loop to judge."""
    if case.grid.real is None or case.controller.deformation.adapts:
        return None
    try:
        radius = max(one.radius for one in real_loops(case.grid, case.controller))
    except (FpirhcError, np.linalg.LinAlgError):
        return None
    text, numbers = f"the slowest or fastest growing mode is multiplied by {radius:.6g} per cycle", {"radius": radius}
    if radius < 1:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    change = "Lower the rate of the tracking law, or the weights of the plan."
    return Answer(TEXT, Verdict.UNKNOWN if radius < 1 + NEUTRAL else Verdict.NO, text, change, numbers)


QUESTION = ControllerQuestion(plain_pair_converges, order=5, adaptive=False)
