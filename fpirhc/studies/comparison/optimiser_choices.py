"""The same controllers with other optimisers, by the names that the command line knows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from fpirhc.controllers.base import Controller
from fpirhc.errors import InvalidName, InvalidProblem, nearest
from fpirhc.members import member_modules
from fpirhc.optimisers.base import Optimiser
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.comparison.optimality import planner, with_optimiser


def optimiser_choices() -> dict[str, tuple[str, Callable[[float], Optimiser]]]:
    """Every optimiser that the command line knows: name -> (label, function of the tolerance).

    A member's module offers them as `CHOICES`.
    """
    choices: dict[str, tuple[str, Callable[[float], Optimiser]]] = {}
    for module in member_modules("optimisers"):
        choices |= getattr(module, "CHOICES", {})
    return choices


def with_optimisers(task: Task, names: Sequence[str], controllers: Sequence[str] | None) -> Task:
    """Return the task with its receding-horizon controllers once per optimiser: the headline pair, or those named.

    Raises:
        InvalidName: an unknown optimiser. InvalidProblem: no receding-horizon controller to vary.
    """
    choices = optimiser_choices()
    unknown = [n for n in names if n != "all" and n not in choices]
    if unknown:
        raise InvalidName(f"optimiser '{unknown[0]}' is unknown.{nearest(unknown[0], [*choices, 'all'])}")
    chosen = list(choices) if "all" in names else list(dict.fromkeys(names))
    sources = list(controllers or task.headline or task.controllers)
    varied: dict[str, Controller] = {}
    for name in sources:
        found = planner(task.controllers[name])
        if found is None:
            continue
        tolerance = float(getattr(found.optimiser, "tolerance", 1e-3))
        for key in chosen:
            label, build = choices[key]
            controller = with_optimiser(task.controllers[name], build(tolerance))
            assert controller is not None
            varied[f"{name} ({label})"] = controller
    if not varied:
        raise InvalidProblem(f"problem '{task.name}': none of {', '.join(sources)} plans with an optimiser")
    return replace(task, controllers=varied, headline=None)
