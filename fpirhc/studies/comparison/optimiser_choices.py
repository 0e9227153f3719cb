"""The same controllers with other optimisers, by the names of the command line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import with_optimiser
from fpirhc.errors import InvalidName, InvalidProblem, nearest
from fpirhc.members import member_modules
from fpirhc.optimisers.base import Optimiser
from fpirhc.problem_files.problem_file import Task

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
