"""Does adaptation pay with a dead time that is wrong by a tenth? The plant runs with a longer and a shorter one than is believed.

That a leaky pairing stays stable is proved of the iteration alone (`fpirhc.deformation.leaky`). The loop around it, with a
prediction and a tracking law or a plan, loses its own margin sooner; so it is run, without adaptation and with it.
"""

from __future__ import annotations

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.late import is_late, scaled
from fpirhc.review.nominal_runs import CYCLES
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.simulation.error_pair import ErrorPair, errors_of
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.simulate import simulate
from fpirhc.task.problem import Problem

TEXT = "Does adaptation pay with a dead time that is wrong by a tenth?"
_PERCENT = 10.0


def pays_when_late(case: Case) -> Answer | None:
    """Return the errors with the dead time 10 % longer and shorter, by whole cycles; None without one, or for a plant outside."""
    problem = case.grid.real or case.problem
    if not is_late(problem) or problem.foreign is not None:
        return None
    short = shortened(problem, CYCLES)
    try:
        errors = {name: _errors(scaled(short, p), case.controller) for name, p in _CHANGES.items()}
    except FpirhcError as error:
        return Answer(TEXT, Verdict.UNKNOWN, f"no run: {error}")
    text = "; ".join(f"{name}: {_sentence(one)}" for name, one in errors.items())
    numbers = {f"{name}_{which}": value for name, one in errors.items() for which, value in _numbers(one).items()}
    if all(one.passes for one in errors.values()):
        return Answer(TEXT, Verdict.YES, text, "", numbers)
    harmful = any(one.fails for one in errors.values()) and not case.controller.learns
    change = "Lower the gain or the rate of the loop, or measure the dead time better than to a tenth."
    return Answer(TEXT, Verdict.NO if harmful else Verdict.UNKNOWN, text, change, numbers)


QUESTION = ControllerQuestion(pays_when_late, order=21, of_targets=True)

_CHANGES = {"longer": _PERCENT, "shorter": -_PERCENT}


def _errors(late: Problem, controller: Controller) -> ErrorPair:
    return errors_of(
        late, [simulate(late, one, seed=0, compiled=False) for one in (without_deformation(controller), controller)]
    )


def _sentence(one: ErrorPair) -> str:
    name = one.worst
    return f"rms error of {name} {one.without[name]:.3g} without adaptation and {one.adapted[name]:.3g} with it"


def _numbers(one: ErrorPair) -> dict[str, float]:
    return {"without": one.without[one.worst], "with": one.adapted[one.worst]}
