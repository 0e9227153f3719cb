"""Warns of a controller whose adaptation does harm, from short runs of its problem before anything else runs.

The controller runs with its deformation and without, on the plant of the problem with the exact parameters and on its own model. It
is warned of where adaptation makes the first larger by far, or where it makes an error on the model, with nothing to adapt, that
is larger than that of the wrong model without adaptation. A plant outside is not run for that. A gain that is refused is answered
with the one that a review recommends.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import name_in_task, without_deformation
from fpirhc.errors import FpirhcError, HarmfulAdaptation, NotContractive
from fpirhc.fields.user_code import users_level
from fpirhc.simulation.trials import Trials
from fpirhc.symbolic.latest import Latest
from fpirhc.task.problem import Problem

CYCLES = 300  # of a run
_REASONS: Latest[list[str]] = Latest(8)  # the same values run alike
_REMEDY = (
    "Use ModelReferenced(map), which leaves an exact model alone, or ask fpirhc review. To silence this, and spare the runs: "
    'warnings.simplefilter("ignore", fpirhc.HarmfulAdaptation)'
)


def warn_of_harm(problem: Problem, controller: Controller) -> None:
    """Warn once where adaptation does harm; nothing is run where the warning is ignored, or nothing adapts a fixed model."""
    if not controller.deformation.adapts or controller.learns or _ignored():
        return
    try:
        reasons = _REASONS.of((problem, controller), (), lambda: _reasons(problem, controller))
    except FpirhcError:  # what the runs cannot do says nothing about the controller
        return
    if reasons:
        what = ", ".join(part for part in (problem.name, name_in_task(controller)) if part)
        text = f"{what}: adaptation does harm, by runs of {CYCLES} cycles: {'; '.join(reasons)}. {_REMEDY}"
        warnings.warn(text, HarmfulAdaptation, stacklevel=users_level())


@contextmanager
def with_recommended_gain(problem: Problem, controller: Controller) -> Iterator[None]:
    """Add the recommended gain to a refusal of the controller's gain within it."""
    try:
        yield
    except NotContractive as error:
        review = import_module(
            "fpirhc.review.recommended_gain"
        )  # of a layer above, which is only asked when nothing else follows
        advice = review.recommended_for(problem, controller)
        if advice is None:
            raise
        raise NotContractive(f"{error}; {advice.text}") from None


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
    real, null = Trials(problem, without_deformation(controller), cycles=CYCLES).errors(controller)
    reasons = [] if real is None or not real.fails else [f"on the plant {real.sentence}"]
    if null.fails and (real is None or null.adapted[null.worst] > real.without[null.worst]):
        reasons.append(f"on its own model, with nothing to adapt {null.sentence}")
    return reasons
