"""Open-loop solves of a problem's first horizon with the optimisers that the command line names, and a certificate of each plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import with_optimiser
from fpirhc.errors import InvalidName, InvalidProblem, nearest
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.members import member_modules
from fpirhc.optimisers.base import Optimiser
from fpirhc.optimisers.certificate import Certificate, certify
from fpirhc.optimisers.plan import Plan, solve
from fpirhc.problem_files.problem_file import Task
from fpirhc.task.exogenous import previewed_values


@dataclass(frozen=True, eq=False)
class Solved:
    """One optimiser's plan."""

    name: str  # label of the optimiser
    plan: Plan
    certificate: Certificate | None  # certificate of the plan; None where the plan is not inside its bounds


def solve_first(task: Task, names: Sequence[str], tolerance: float) -> list[Solved]:
    """Solve the horizon that begins at the start of the problem, with the approximate model.

    `names`: names of optimisers; 'all' among them stands for every optimiser.
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


Choice = tuple[str, Callable[[float], Optimiser]]  # label, function of the tolerance


def optimiser_choices() -> dict[str, Choice]:
    """Return every optimiser of the command line: name -> (label, function of the tolerance).

    The modules of the optimisers define them as `CHOICES`.
    """
    choices: dict[str, Choice] = {}
    for module in member_modules("optimisers"):
        choices |= getattr(module, "CHOICES", {})
    return choices


def chosen_optimisers(names: Sequence[str]) -> dict[str, Choice]:
    """Return the choices of these names; 'all' among them stands for every optimiser."""
    choices = optimiser_choices()
    unknown = [n for n in names if n != "all" and n not in choices]
    if unknown:
        raise InvalidName(f"optimiser '{unknown[0]}' is unknown.{nearest(unknown[0], [*choices, 'all'])}")
    return choices if "all" in names else {name: choices[name] for name in names}


def with_optimisers(task: Task, names: Sequence[str], controllers: Sequence[str] | None) -> Task:
    """Return the task with its planning controllers once per optimiser: the headline pair, or those named.

    A controller that is named and does not plan stays as it is.
    """
    choices = list(chosen_optimisers(names).values())
    sources = list(controllers or task.headline or task.controllers)
    planning = [name for name in sources if task.controllers[name].planner is not None]
    if not planning:
        raise InvalidProblem(f"problem '{task.name}': none of {', '.join(sources)} plans with an optimiser")
    varied: dict[str, Controller] = {}
    for name in sources if controllers else planning:
        varied |= _varied(name, task.controllers[name], choices)
    return replace(task, controllers=varied, headline=None)


def _varied(name: str, controller: Controller, optimisers: Sequence[Choice]) -> dict[str, Controller]:
    """The controller by name, once per optimiser; unchanged where it does not plan."""
    if controller.planner is None:
        return {name: controller}
    tolerance = float(getattr(controller.planner.optimiser, "tolerance", 1e-3))
    return {f"{name} ({label})": with_optimiser(controller, build(tolerance)) for label, build in optimisers}
