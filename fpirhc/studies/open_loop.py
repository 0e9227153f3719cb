"""Open-loop solves of a problem's first horizon, with a certificate of each plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fpirhc.errors import InvalidProblem
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.certificate import Certificate, certify
from fpirhc.optimisers.plan import Plan, solve
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.comparison.optimiser_choices import chosen_optimisers
from fpirhc.task.exogenous import previewed_values


@dataclass(frozen=True, eq=False)
class Solved:
    """One optimiser's plan."""

    name: str  # label of the optimiser
    plan: Plan  # its plan
    certificate: Certificate | None  # certificate of the plan; None where the plan is not inside its bounds


def solve_first(task: Task, names: Sequence[str], tolerance: float) -> list[Solved]:
    """Solve the horizon that begins at the start of the problem, with the approximate model.

    Args:
        names: names of optimisers; 'all' among them stands for every optimiser.
    """
    problem = task.problem
    if problem.horizon is None or problem.cost is None:
        raise InvalidProblem(f"problem '{task.name}' has no horizon or no cost; give Problem(horizon=..., cost=...)")
    choices = chosen_optimisers(names)
    plant = problem.plant
    ahead = previewed_values(plant, problem.signals)
    limits, start = problem.limits, problem.start_state
    ocp = transcribe(plant, problem.reference, problem.horizon, problem.cost, limits, ahead, start)
    data_of = stage_data(plant, problem.reference, problem.horizon, problem.cost, signals=ahead)
    data = np.asarray(data_of(0.0, plant.approximate).full())
    first = np.asarray(ocp.start(problem.start_state, problem.inputs_before).full()).ravel()
    solved = []
    for label, build in choices.values():
        plan = solve(ocp, build(tolerance), first, data)
        solved.append(Solved(label, plan, None if plan.overflow() else certify(plan)))
    return solved
