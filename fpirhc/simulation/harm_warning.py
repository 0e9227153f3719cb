"""Warns of a controller whose adaptation does harm, from short runs of its problem before anything else runs.

The controller runs with its deformation and without, on the plant of the problem with the exact parameters and on its own model. It
is warned of where adaptation makes the first larger by far, or where it makes an error on the model, with nothing to adapt, that
is larger than that of the wrong model without adaptation. A plant outside is not run for that.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from fpirhc.controllers.base import Controller
from fpirhc.errors import FpirhcError, HarmfulAdaptation
from fpirhc.fields.place import users_level
from fpirhc.simulation.error_pair import ErrorPair, errors_of
from fpirhc.simulation.model_as_plant import ModelAsPlant, shortened
from fpirhc.simulation.simulate import simulator
from fpirhc.task.problem import Problem

CYCLES = 300  # of a run
_REMEDY = (
    "Use ModelReferenced(map), which leaves an exact model alone, or ask fpirhc review. To silence this, and spare the runs: "
    'warnings.simplefilter("ignore", fpirhc.HarmfulAdaptation)'
)


def warn_of_harm(problem: Problem, controller: Controller) -> None:
    """Warn once where adaptation does harm; nothing is run where the warning is ignored, or nothing adapts a fixed model."""
    if not controller.deformation.adapts or controller.learns or _ignored():
        return
    try:
        reasons = _reasons(shortened(problem, CYCLES), controller)
    except FpirhcError:  # what the runs cannot do says nothing about the controller
        return
    if reasons:
        what = f"{problem.name}, {controller.task_name or type(controller).__name__}"
        text = f"{what}: adaptation does harm, by runs of {CYCLES} cycles: {'; '.join(reasons)}. {_REMEDY}"
        warnings.warn(text, HarmfulAdaptation, stacklevel=users_level())


@contextmanager
def without_warning() -> Iterator[None]:
    """Ignore the warning, for steppers of controllers that are judged anyway."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HarmfulAdaptation)
        yield


def _ignored() -> bool:
    """Whether the first filter for the warning ignores it, whatever its text and place."""
    for action, message, category, module, _ in warnings.filters:
        if issubclass(HarmfulAdaptation, category) and message is None and module is None:
            return action == "ignore"
    return False


def _reasons(problem: Problem, controller: Controller) -> list[str]:
    loops = [simulator(problem, c, compiled=False) for c in (controller.unadapted(), controller)]
    model = ModelAsPlant(problem, seed=0).behind(loops[1].controller.deformation)
    null = errors_of(model.problem, [model.run(loop) for loop in loops])
    if problem.foreign is not None:
        return [_sentence("on its own model", null)] if null.fails else []
    real = errors_of(problem, [loop.run(seed=0) for loop in loops])
    reasons = [_sentence("on the plant", real)] if real.fails else []
    if null.fails and null.adapted[null.worst] > real.without[null.worst]:
        reasons.append(_sentence("on its own model, with nothing to adapt", null))
    return reasons


def _sentence(where: str, errors: ErrorPair) -> str:
    name = errors.worst
    after = (
        f"{errors.adapted[name]:.3g} with it"
        if math.isfinite(errors.adapted[name])
        else "a run that ends early with it"
    )
    return f"{where} the rms error of {name} is {errors.without[name]:.3g} without adaptation, {after}"
