"""Does the integrator follow the reality along the reference? The check before a run looks at the start alone."""

from __future__ import annotations

import numpy as np

from fpirhc.plant.stiffness import poles, stiffness
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.question import ProblemQuestion
from fpirhc.review.real_pair import real_points

TEXT = "Does the integrator follow the reality along the reference?"


def reality_followed(grid: ReviewGrid) -> Answer | None:
    """Return whether a decaying mode of the reality grows where it settles on the reference; None without a reality."""
    problem = grid.real
    if problem is None:
        return None
    points = real_points(grid)
    if not points:
        return Answer(TEXT, Verdict.UNKNOWN, "the reality nowhere settles on the reference")
    plant, integrator = problem.real_plant, problem.real_integrator
    fastest_first = sorted(points, key=lambda one: -np.abs(poles(plant, one.real, one.command, plant.exact)).max())
    for point in fastest_first:
        stiff = stiffness(plant, integrator, problem.period, point.real, point.command, plant.exact)
        if stiff:
            what, _, remedy = stiff.partition("; use ")
            where = f"at t = {grid.times[point.place]:g} {problem.time_unit} "
            return Answer(TEXT, Verdict.NO, where + what, f"Use Reality({remedy}).")
    return Answer(TEXT, Verdict.YES, f"no decaying mode grows at {len(points)} points of the reference")


QUESTION = ProblemQuestion(ask=reality_followed, order=21)
