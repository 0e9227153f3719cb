"""The same controllers with other optimisers, by the names that the command line knows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from fpirhc.controllers.base import Controller
from fpirhc.errors import InvalidName, InvalidProblem, nearest
from fpirhc.optimisers.base import Optimiser
from fpirhc.optimisers.fixed_point import FixedPoint
from fpirhc.optimisers.nlp import Fatrop, Ipopt, Osqp, SequentialQuadratic
from fpirhc.optimisers.reduced_gradient import ReducedGradient
from fpirhc.problem_files.problem_file import Task

OPTIMISERS: dict[str, tuple[str, Callable[[float], Optimiser]]] = {
    "fixed-point": ("FPI", lambda tolerance: FixedPoint(iterations=1, tolerance=tolerance)),
    "reduced-gradient": ("reduced gradient", lambda tolerance: ReducedGradient(iterations=50, tolerance=tolerance)),
    "ipopt": ("IPOPT", lambda tolerance: Ipopt(tolerance=tolerance)),
    "fatrop": ("fatrop", lambda tolerance: Fatrop(tolerance=tolerance)),
    "qrqp": ("SQP qrqp", lambda tolerance: SequentialQuadratic(tolerance=tolerance)),
    "osqp": ("SQP OSQP", lambda tolerance: SequentialQuadratic(tolerance=tolerance, quadratic=Osqp())),
    "osqp-rti": (
        "OSQP, one iteration",
        lambda tolerance: SequentialQuadratic(tolerance=tolerance, quadratic=Osqp(), iterations=1),
    ),
}


def with_optimisers(task: Task, names: Sequence[str], controllers: Sequence[str] | None) -> Task:
    """Return the task with its planning controllers once per optimiser: the headline pair, or those named.

    A controller that is named and does not plan stays as it is.

    Raises:
        InvalidName: an unknown optimiser. InvalidProblem: no planning controller to vary.
    """
    unknown = [n for n in names if n != "all" and n not in OPTIMISERS]
    if unknown:
        raise InvalidName(f"optimiser '{unknown[0]}' is unknown.{nearest(unknown[0], [*OPTIMISERS, 'all'])}")
    chosen = list(OPTIMISERS) if "all" in names else list(dict.fromkeys(names))
    sources = list(controllers or task.headline or task.controllers)
    planning = [name for name in sources if task.controllers[name].planner is not None]
    if not planning:
        raise InvalidProblem(f"problem '{task.name}': none of {', '.join(sources)} plans with an optimiser")
    varied: dict[str, Controller] = {}
    for name in sources if controllers else planning:
        varied |= _varied(name, task.controllers[name], chosen)
    return replace(task, controllers=varied, headline=None)


def _varied(name: str, controller: Controller, optimisers: Sequence[str]) -> dict[str, Controller]:
    """The controller by name, once per optimiser."""
    if controller.planner is None:
        return {name: controller}
    tolerance = float(getattr(controller.planner.optimiser, "tolerance", 1e-3))
    built = {label: build(tolerance) for label, build in (OPTIMISERS[key] for key in optimisers)}
    return {f"{name} ({label})": controller.with_optimiser(optimiser) for label, optimiser in built.items()}
