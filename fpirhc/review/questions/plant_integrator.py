"""Does the integrator follow the simulated plant? A step that is too long for a fast mode makes a run that no plant would make."""

from __future__ import annotations

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import ProblemQuestion
from fpirhc.review.stages import CYCLE, Place, advice, step_poles

TEXT = "Does the integrator follow the simulated plant?"
_POINTS = 5  # of the reference


def integrator_follows(grid: ReviewGrid) -> Answer | None:
    """Return how far poles of a cycle are from those of the plant; None for a map and for methods that control their error."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.integrator.opaque or problem.integrator.steps_maps:
        return None
    usable = [k for k in range(len(grid.times)) if np.isfinite(grid.commands[0, k]).all()]
    points = [usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, _POINTS).astype(int))] if usable else []
    places = [Place(grid.states[k], grid.commands[0, k], plant.exact) for k in points]
    try:
        poles = [step_poles(plant, problem.integrator, problem.period, place) for place in places]
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(TEXT, Verdict.UNKNOWN, f"the poles are not known: {error}")
    if not poles:
        return Answer(TEXT, Verdict.UNKNOWN, "the inverse does not exist along the reference")
    worst = max(range(len(poles)), key=lambda k: (poles[k].unstable, poles[k].apart))
    one = poles[worst]
    text = f"cycle of {problem.period:g} {problem.time_unit}, fastest mode {one.fastest:.3g} {problem.rate_unit}"
    text += f"; poles of the cycle are off by {one.apart:.2g} at most"
    numbers = {"apart": one.apart, "fastest_mode": one.fastest, "largest_pole": one.largest}
    if one.follows:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    change = advice(CYCLE, plant, problem.integrator, problem.period, places[worst])
    return Answer(TEXT, Verdict.NO if one.unstable else Verdict.UNKNOWN, text, change, numbers)


QUESTION = ProblemQuestion(ask=integrator_follows, order=20)
