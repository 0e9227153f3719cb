"""Do the signals from outside stay at their nominal values, for which the review is made?"""

from __future__ import annotations

import numpy as np

from fpirhc.plant.motion import outside_names
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import ProblemQuestion
from fpirhc.task.exogenous import real_values, rows_of

TEXT = "Do signals from outside stay where the review sees them?"
_SAME = 1e-9  # relative distance that counts as none


def stay_nominal(grid: ReviewGrid) -> Answer | None:
    """Return whether every signal from outside has its nominal value all the time; None without signals."""
    problem = grid.real if grid.real is not None else grid.problem
    plant = problem.real_plant
    if not outside_names(plant):
        return None
    times = np.linspace(0.0, problem.duration, len(grid.times))
    rows = rows_of(real_values(plant, problem.signals), times, plant.exact)
    facts, moves = [], False
    for name in outside_names(plant):
        place = plant.parameter.elements.index(name)
        low, high, nominal = rows[:, place].min(), rows[:, place].max(), plant.parameters[name].exact
        moves |= max(abs(low - nominal), abs(high - nominal)) > _SAME * (1 + abs(nominal))
        facts.append(f"{name} is {nominal:.6g} {plant.parameters[name].unit} here, {low:.6g} to {high:.6g} in the run")
    change = "Review other values too: outside(nominal=...)." if moves else ""
    return Answer(TEXT, Verdict.UNKNOWN if moves else Verdict.YES, "; ".join(facts), change)


QUESTION = ProblemQuestion(ask=stay_nominal, order=22)
