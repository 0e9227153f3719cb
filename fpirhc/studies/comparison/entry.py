"""What a comparison knows of one controller: its run, what was measured and predicted, and facts for the verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.contraction.spectrum import ContractionReport, Spectrum
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import innermost
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Verdict
from fpirhc.review.grid import review_grid
from fpirhc.review.questions.integration import discretisation_follows
from fpirhc.review.response_prediction import Prediction
from fpirhc.simulation.lyapunov_view import LyapunovView
from fpirhc.simulation.metrics import Metrics
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.studies.comparison.information import Information
from fpirhc.studies.comparison.optimality import Optimality
from fpirhc.studies.comparison.timing import CycleTime, Price
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem, cycles_per_plan


@dataclass(frozen=True, eq=False)
class Contraction:
    """Contraction of one adaptive controller.

    Args:
        predicted: largest factor predicted from the symbols along the measured cycles.
        growing: share of these cycles in which it is 1 or more.
        measured: factor measured from the run.
        report: admissible and recommended gains.
        spectrum: eigenvalues of the response Jacobian along the run.
    """

    predicted: float
    growing: float
    measured: float
    report: ContractionReport
    spectrum: Spectrum


@dataclass(frozen=True, eq=False)
class Entry:
    """One controller of a comparison.

    Args:
        name: name of the controller.
        run: its run.
        metrics: metrics of the run.
        cycle: time of a control cycle; None for a run that is too short.
        adaptive: whether the controller adapts.
        pair: name of the same controller without adaptation, if there is one.
        contraction: contraction of the iteration, if the controller adapts.
        optimality: excess cost of its plans, if it plans.
        notes: sentences for the report.
        lyapunov: Lyapunov function along the run, if one is known.
        prediction: prediction of the response, for the adaptive controller of the headline.
        weighed: judged coordinates that its cost weighs; None: all.
        exact: whether its model is exact where the others' is not, so that it should be a bound.
        learns: whether its model or its gains change during a run.
        fixed: name of the same controller with a model that does not change, for one that learns, if there is one.
        plan_every: cycles from plan to plan; 1 for a controller that does not plan.
        price: its time per cycle beside that of its pair.
        no_bound: why it is no bound, for an exact model that an adapted controller beats.
        information: what it measures and when it acts; None: not asked.
        automatic: settings of its deformation that were chosen automatically.
        reviewed_gain: what a review says of a gain that is too large or too small; empty where it is neither, or was not asked.
        not_reached: what a review says of wrong parameters that adaptation does not correct; empty likewise.
    """

    name: str
    run: Run
    metrics: Metrics
    cycle: CycleTime | None
    adaptive: bool
    pair: str | None
    contraction: Contraction | None
    optimality: Optimality | None = None
    notes: tuple[str, ...] = ()
    lyapunov: LyapunovView | None = None
    prediction: Prediction | None = None
    weighed: frozenset[str] | None = None
    exact: bool = False
    learns: bool = False
    fixed: str | None = None
    plan_every: int = 1
    price: Price | None = None
    no_bound: tuple[str, ...] = ()
    information: Information | None = None
    automatic: tuple[str, ...] = ()
    reviewed_gain: str = ""
    not_reached: str = ""


_MUCH = 1e-2  # relative cost above the optimum


def plan_every(problem: Problem, controller: Controller) -> int:
    """Return the number of cycles from plan to plan; 1 where neither the controller nor what it wraps plans."""
    if innermost(controller).planner is None or problem.horizon is None:
        return 1
    return cycles_per_plan(problem.horizon, problem.period)


def has_exact_model(problem: Problem, controller: Controller) -> bool:
    """Whether it is the bound of a controller with a wrong model: exact parameters, nothing adapted, nothing learned."""
    model, real = controller.plant_model(problem), problem.real_plant
    plant = model.plant
    wrong = problem.reality is not None or not np.array_equal(plant.approximate, plant.exact)
    fixed = not controller.deformation.adapts and not controller.learns
    return bool(wrong and fixed and plant is real and np.array_equal(model.parameters(plant), real.exact))


def no_bound_because(
    problem: Problem, controller: Controller, metrics: Metrics, optimality: Optimality | None
) -> tuple[str, ...]:
    """Return why a controller with the exact model need not have the smallest error."""
    reasons = []
    if problem.disturbances:
        reasons.append(f"its model does not hold the disturbance of {', '.join(problem.disturbances)}")
    if any(problem.dead_time.inputs.values()) or problem.dead_time.measurement:
        reasons.append("dead time stands between its model and the plant")
    reasons += _plans_of(problem, controller, metrics, optimality)
    if not reasons:
        own = "its cost weighs more than the error, so the best plan has not the smallest error"
        reasons = ["its law makes this error with a right model too" if controller.planner is None else own]
    return tuple(reasons)


def _plans_of(problem: Problem, controller: Controller, metrics: Metrics, optimality: Optimality | None) -> list[str]:
    """Reasons that lie in the plans."""
    if controller.planner is None or problem.horizon is None:
        return []
    reasons, every = [], plan_every(problem, controller)
    if every > 1:
        reasons.append(f"it plans every {every} cycles, while a deformation acts in each of them")
    missed = 1 - metrics.statuses.get(Status.OK.name, 0) / max(sum(metrics.statuses.values()), 1)
    if missed > 0:
        reasons.append(f"its optimiser did not converge in {in_percent(missed)} of the cycles")
    if optimality is not None and optimality.median > _MUCH:
        reasons.append(f"the cost of its plans is {100 * optimality.median:.2g} % above the converged optimum")
    return reasons + _discretisation(problem, controller)


def _discretisation(problem: Problem, controller: Controller) -> list[str]:
    try:
        answer = discretisation_follows(review_grid(controller.inner_problem(problem), 0.0, 0))
    except FpirhcError:
        return []
    if answer is None or answer.verdict == Verdict.YES:
        return []
    return [f"the discretisation of its horizon does not follow the plant ({answer.evidence})"]
