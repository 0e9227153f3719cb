"""Do the optimiser's iterations suffice for this horizon? The model is run as its own plant, without deformation.

A plan that did not converge is not the optimum of its cost: what is judged then is where the optimiser gave up. Where too many
plans beyond the start are of this kind, the run is repeated with 2, 4, 8, 16 times the iterations, and the first number that
suffices is named.
"""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import with_optimiser, without_deformation
from fpirhc.describe import as_written
from fpirhc.errors import FpirhcError
from fpirhc.optimisers.base import Optimiser
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.nominal_runs import null_problem
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.status import Status
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem, cycles_per_plan

TEXT = "Do the optimiser's iterations suffice for this horizon?"
MANY = 0.05  # share of the cycles from which plans that did not converge are a cause
_PLANS = 100  # of a run
_MORE = (2, 4, 8, 16)


def iterations_suffice(case: Case) -> Answer | None:
    """Return the share of the cycles whose plan did not converge on the right model; None for a controller that does not plan."""
    planner, horizon = case.controller.planner, case.problem.horizon
    if planner is None or horizon is None:
        return None
    try:
        bare = without_deformation(case.controller)
        model = shortened(null_problem(case.problem, bare), _PLANS * cycles_per_plan(horizon, case.problem.period))
        share, later = unsolved(case.runs.bare(bare), model.cycles)
    except FpirhcError as error:
        return Answer(TEXT, Verdict.UNKNOWN, f"no run of the model: {error}")
    text = f"on its own model {in_percent(share)} of the first {model.cycles} cycles have a plan that did not converge"
    numbers = {"unsolved": share, "unsolved_later": later}
    if share < MANY:
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    text += f", of the second half of them {in_percent(later)}"
    if later < MANY:
        return Answer(
            TEXT, Verdict.UNKNOWN, text, "Give the optimiser more iterations where the start matters.", numbers
        )
    return Answer(TEXT, Verdict.NO, text, _remedy(model, bare, planner.optimiser), numbers)


QUESTION = ControllerQuestion(iterations_suffice, order=1, adaptive=False)


def unsolved(run: Run, cycles: int) -> tuple[float, float]:
    """Return the share of the first cycles with a plan that did not converge, and of their second half; 1 where the run ends."""
    if run.cycles < cycles:
        return 1.0, 1.0
    failed = run["status"][:cycles] == Status.NOT_CONVERGED
    return float(np.mean(failed)), float(np.mean(failed[cycles // 2 :]))


def _remedy(model: Problem, bare: Controller, optimiser: Optimiser) -> str:
    for times in _MORE:
        longer = optimiser.longer(times)
        if longer is None:
            return "Take an optimiser that iterates until its plans are solved, or shorten the horizon."
        try:
            run = simulate(model, with_optimiser(bare, longer), seed=0, compiled=False)
            if unsolved(run, model.cycles)[1] < MANY:
                return f"Give the optimiser {times} times the iterations: {as_written(longer)}."
        except FpirhcError:
            break
    return f"Not even {_MORE[-1]} times the iterations suffice: shorten the horizon, or make the cost or its reference gentler."
