"""All questions about a problem and its controllers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from fpirhc.controllers.base import Controller
from fpirhc.controllers.informed import Informed
from fpirhc.controllers.slotted import Slotted
from fpirhc.deformation.identity import Identity
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.problem import Problem
from fpirhc.studies.review.along import Along, along
from fpirhc.studies.review.answer import Answer, Review, Verdict
from fpirhc.studies.review.commands import commands_inside
from fpirhc.studies.review.convergence import box_converges, converges
from fpirhc.studies.review.gain import gain_admissible
from fpirhc.studies.review.horizon import horizon_long_enough
from fpirhc.studies.review.inverse import inverse_exists
from fpirhc.studies.review.loops import Loops, loops_along
from fpirhc.studies.review.maps import largest_product
from fpirhc.studies.review.margins import margins_enough
from fpirhc.studies.review.neighbourhood import spectrum_near
from fpirhc.studies.review.orders import relative_orders
from fpirhc.studies.review.rates import rates_inside
from fpirhc.studies.review.reach import range_enough
from fpirhc.studies.review.schedule import schedule_stable
from fpirhc.studies.review.signs import one_sign
from fpirhc.studies.review.slew import slew_enough
from fpirhc.studies.review.well_posed import well_posed
from fpirhc.studies.review.zero_dynamics import is_planned, zero_dynamics, zero_dynamics_rate

LARGEST_MISMATCH = 100.0  # percent; beyond it a parameter may change its sign


def review(problem: Problem, controllers: Mapping[str, Controller], *, mismatch: float, seed: int) -> Review:
    """Return the answers to all questions that can be asked before a run.

    Parameters: `mismatch`: margin around the exact parameters, percent, 0 <= P < 100; the box spans the approximate values too.
    `seed` of the draws from the box.

    Raises:
        InvalidValue: a mismatch out of range. NotInvertible: the inputs and the controlled coordinates differ in number.
    """
    if not (math.isfinite(mismatch) and 0 <= mismatch < LARGEST_MISMATCH):
        raise InvalidValue(f"mismatch={mismatch!r}: expected percent of at least 0 and below {LARGEST_MISMATCH:g}")
    al = along(problem, mismatch, seed)
    general = [well_posed(al), relative_orders(al), inverse_exists(al), commands_inside(al)]
    far = horizon_long_enough(al)
    if far is not None:
        general.append(far)
    return Review(tuple(general), {name: _of(al, one, general) for name, one in controllers.items()}, mismatch)


def predict(problem: Problem, controller: Controller) -> Answer:
    """Return the verdict alone: whether the deformation of a controller converges on the plant with its exact parameters.

    Raises:
        NotInvertible: see `review`. And what the controller raises about the problem.
    """
    al = along(problem, 0.0, 0)
    own = replace(al, draws=al.draws[:1])  # the box does not matter
    chosen = controller.resolved(problem)
    general = [well_posed(own), inverse_exists(own), commands_inside(own)]
    loops = loops_along(own, chosen)
    return converges(own, chosen, loops, _doubts([*general, *_speed_and_range(own, chosen, loops)]))


def _of(al: Along, controller: Controller, general: list[Answer]) -> tuple[Answer, ...]:
    try:
        chosen = controller.resolved(al.problem)
        chosen.check(al.problem)
    except FpirhcError as error:
        return (Answer("Does the controller fit the problem?", Verdict.NO, str(error), "See the message."),)
    inside = chosen.controller if isinstance(chosen, Informed) else chosen
    if isinstance(inside, Slotted):
        return (schedule_stable(al.problem, inside),)
    loops = loops_along(al, chosen)
    outer = [rates_inside(al, chosen, loops), zero_dynamics(zero_dynamics_rate(al), is_planned(chosen), loops)]
    inner = [] if isinstance(chosen.adaptive, Identity) else _of_map(al, chosen, loops, general)
    return (*inner, *outer, margins_enough(al.problem, loops))


def _of_map(al: Along, controller: Controller, loops: Loops, general: list[Answer]) -> list[Answer]:
    deformation = controller.adaptive
    believed = controller.parameters(al.problem.plant)
    try:
        own, boxed = (spectrum_near(al, believed, draws, near=False) for draws in (al.draws[:1], al.draws))
    except InvalidValue as error:
        return [Answer("Do the eigenvalues of the response Jacobian have one sign?", Verdict.UNKNOWN, str(error))]
    limit = largest_product(al.problem, deformation)
    suited = _speed_and_range(al, controller, loops)
    verdict = converges(al, controller, loops, _doubts([*general, *suited]))
    gains = [one_sign(own, boxed), gain_admissible(deformation, own, boxed, limit)]
    return [verdict, box_converges(loops), *gains, *suited]


def _speed_and_range(al: Along, controller: Controller, loops: Loops) -> list[Answer]:
    deformation, believed = controller.adaptive, controller.parameters(al.problem.plant)
    ideal = loops.ideal if is_planned(controller) else None
    found = [slew_enough(al, deformation, believed, ideal), range_enough(al, deformation, believed)]
    return [a for a in found if a is not None]


def _doubts(answers: list[Answer]) -> list[str]:
    return [f"'{a.question}' is answered no" for a in answers if a.verdict == Verdict.NO]
