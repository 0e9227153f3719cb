"""Is the chatter that the noise of measured responses causes small? By the linear loop of map, filter and plant."""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.noise_along import chatter_of

QUESTION = "Is the chatter from measured responses small?"
SMALL = 0.01  # of the range between an input's limits


def chatter_small(grid: ReviewGrid, controller: Controller) -> Answer | None:
    """Return the rms steps of the commands that noise causes; None without white noise on a response, or where it is late."""
    problem, deformation = grid.problem, controller.deformation
    if problem.sensing.ideal or problem.response_delay > 0 or not deformation.iteration.constant:
        return None
    try:
        steps = chatter_of(grid, controller, deformation.effective_gain(), deformation.iteration.error_pole)
    except FpirhcError:
        return None
    lower, upper = problem.limits.input_bounds(problem.plant)
    share = float(np.max(np.array(list(steps.values())) / (upper - lower)))
    text = "rms step per cycle from noise: " + ", ".join(f"{i} {v:.3g}" for i, v in steps.items())
    numbers = {f"step_{i}": v for i, v in steps.items()} | {"share_of_limits": share}
    if share < SMALL:
        return Answer(QUESTION, Verdict.YES, text, "", numbers)
    change = "fp.suggest(problem, controller, chatter=...) gives the gain and the filter for a smaller one."
    return Answer(QUESTION, Verdict.UNKNOWN, text, change, numbers)
