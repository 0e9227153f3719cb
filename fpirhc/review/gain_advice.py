"""The recommended gain of a controller, tried in runs: the one number that review, report and refusal name."""

from __future__ import annotations

import math
from dataclasses import replace

from fpirhc.contraction.gains import assess_gain
from fpirhc.contraction.spectrum import Spectrum
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import review_grid
from fpirhc.review.loops import loops_along
from fpirhc.review.maps import largest_product
from fpirhc.review.neighbourhood import spectrum_near
from fpirhc.review.nominal_runs import NominalRuns
from fpirhc.review.null_test import leaves_right_model_alone
from fpirhc.review.question import Case
from fpirhc.review.recommended_gain import Recommended, recommended_gain
from fpirhc.task.problem import Problem


def gain_advice(case: Case, boxed: Spectrum, null: Answer | None) -> Recommended:
    """Return the recommended gain of a controller; none where it fails the null test, or where a run with that gain does harm.

    Where its own gain is beyond the limits, the null test of a gain within them counts.

    Args:
        case: of the controller.
        boxed: eigenvalues of the response Jacobian over the box of parameters.
        null: the answer whether adaptation leaves a right model alone.
    """
    deformation = case.controller.deformation
    report = assess_gain(deformation, boxed)
    share = largest_product(case.problem, deformation, boxed.eigenvalues) / 2
    low, high = (share * end for end in report.sector_limit)
    if low < high and not low < deformation.effective_gain() < high:
        safe = _with_gain(case, 0.5 * (low + high))
        return replace(gain_advice(safe, boxed, leaves_right_model_alone(safe)), exceeded=True)
    advice = recommended_gain(deformation, report, share, case.by_gain)
    if advice.why_not:
        return advice
    if null is not None and null.verdict == Verdict.NO:
        against = "adaptation does not leave a right model alone"
    else:
        own = getattr(deformation, deformation.gain_name, None)
        size = advice.value if own is None else advice.value / float(own) * deformation.effective_gain()
        harm = case.harm(deformation.with_effective_gain(size))
        against = f"with {advice.value:.3g}, half of it, {harm}" if harm else ""
    return replace(advice, value=math.nan, why_not=against) if against else advice


def recommended_for(problem: Problem, controller: Controller) -> Recommended | None:
    """Return the gain that a review of a controller recommends, also where its own gain is refused; None where it has no answer."""
    try:
        grid = review_grid(problem, 0.0, 0)
        ready = resolved(grid.problem, controller)
        boxed = spectrum_near(
            grid, ready.plant_model(grid.problem).parameters(grid.problem.plant), grid.draws, near=False
        )
        case = Case(grid, ready, loops_along(grid, ready), NominalRuns(grid.problem))
        return gain_advice(case, boxed, leaves_right_model_alone(case))
    except FpirhcError:
        return None


def _with_gain(case: Case, gain: float) -> Case:
    """The case of the controller with another effective gain."""
    deformation = case.controller.deformation.with_effective_gain(gain)
    controller = resolved(case.problem, case.controller.with_deformation(deformation))
    return Case(case.grid, controller, loops_along(case.grid, controller), case.runs)
