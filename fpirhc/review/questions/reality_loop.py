"""Does the loop of the model's controller around the reality converge? Both are linear plants at points of the reference.

The reality has states that the model lacks, so the eigenvalues of the response Jacobian do not decide: the poles of the whole loop
do, with the integrator, the estimator and the dead times in it.
"""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.contract import without_deformation
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.review.real_pair import real_loops
from fpirhc.simulation.linearise.linear_loop import NEUTRAL

TEXT = "Does the loop with the reality converge?"


def real_pair_converges(case: Case) -> Answer | None:
    """Return the largest pole of the real pair along the reference; None without a reality that is a plant."""
    if case.grid.real is None:
        return None
    try:
        adapted = max(one.radius for one in real_loops(case.grid, case.controller))
        bare = max(one.radius for one in real_loops(case.grid, without_deformation(case.controller)))
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(TEXT, Verdict.UNKNOWN, f"no linear loop of the real pair: {error}")
    text = f"the slowest or fastest growing mode is multiplied by {adapted:.6g} per cycle, without adaptation by {bare:.6g}"
    numbers = {"radius": adapted, "bare_radius": bare}
    if adapted < 1:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    mirror = case.controller.deformation.mirror
    paired = mirror is not None and mirror.lags
    change = "Lower the gain, or pair through " + (
        "the whole lag of the reality." if paired else "the reality's lag: ModelReferenced(map, lag=...)."
    )
    if bare >= 1:
        change = "Lower the rate of the tracking law: the loop does not converge without adaptation either."
    return Answer(TEXT, Verdict.UNKNOWN if adapted < 1 + NEUTRAL else Verdict.NO, text, change, numbers)


QUESTION = ControllerQuestion(real_pair_converges, order=5, doubts=True, of_targets=True)
