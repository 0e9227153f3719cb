"""Facts for the verdict about a controller on a problem: what its cost weighs, its rate, why its exact model is no bound."""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Verdict
from fpirhc.review.grid import review_grid
from fpirhc.review.questions.integration import discretisation_follows
from fpirhc.simulation.metrics import Metrics
from fpirhc.status import Status
from fpirhc.studies.comparison.optimality import Optimality
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem, cycles_per_plan

_MUCH = 1e-2  # relative cost above the optimum


def plan_every(problem: Problem, controller: Controller) -> int:
    """Return the number of cycles from plan to plan; 1 for a controller that does not plan."""
    if controller.planner is None or problem.horizon is None:
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
    if not reasons and controller.planner is not None:
        reasons.append("its cost weighs more than the error, so the best plan has not the smallest error")
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
