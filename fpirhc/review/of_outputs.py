"""A review of a plant with outputs: the questions that its linear loop and its response Jacobian answer.

The points are those of a simulation of the plant while its outputs follow their reference. The other questions look at references
of states, which such a plant does not have; they are named as not covered.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import checked
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.review.answer import Answer, Review, Verdict
from fpirhc.review.commands import commands_inside
from fpirhc.review.convergence import box_converges, converges
from fpirhc.review.gain import gain_admissible
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.inverse import inverse_exists
from fpirhc.review.loops import Loops, loops_along
from fpirhc.review.maps import largest_product
from fpirhc.review.neighbourhood import spectrum_near
from fpirhc.review.of_order_zero import controls_order_zero, review_of_order_zero
from fpirhc.review.orders import relative_orders
from fpirhc.review.questions.believed_states import right_after_a_while
from fpirhc.review.signs import one_sign
from fpirhc.review.stand_in import is_planned
from fpirhc.review.well_posed import well_posed
from fpirhc.review.zero_dynamics import zero_dynamics, zero_dynamics_rate

_NOT_COVERED = (
    "not covered for outputs: horizon and discretisation, jumps and limits along the reference, the map's step limit and range, "
    "two-cycles, basin, noise, dead times of the box, null test, and a reality's own modes"
)


def review_of_outputs(grid: ReviewGrid, controllers: Mapping[str, Controller]) -> Review:
    """Return the answers about a problem whose plant has outputs.

    Args:
        grid: points and draws of the problem.
        controllers: by name.
    """
    if controls_order_zero(grid):
        return review_of_order_zero(grid, controllers)
    general = [well_posed(grid), relative_orders(grid), inverse_exists(grid), commands_inside(grid)]
    believed = right_after_a_while(grid)
    rest = Answer("What do the other questions say?", Verdict.UNKNOWN, _NOT_COVERED, "Run it and compare.")
    answers = {name: _of(grid, one, general) for name, one in controllers.items()}
    return Review((*general, *([believed] if believed else []), rest), answers, grid.mismatch)


def verdict_of_outputs(grid: ReviewGrid, controller: Controller) -> Answer:
    """Return whether the deformation of a controller converges.

    Raises:
        FpirhcError: every error that the controller raises about the problem.
    """
    ready = checked(grid.problem, controller)
    general = [well_posed(grid), inverse_exists(grid), commands_inside(grid)]
    return _verdict(grid, ready, loops_along(grid, ready), general)


def _of(grid: ReviewGrid, controller: Controller, general: list[Answer]) -> tuple[Answer, ...]:
    try:
        ready = checked(grid.real or grid.problem, controller)
    except FpirhcError as error:
        return (Answer("Does the controller fit the problem?", Verdict.NO, str(error), "See the message."),)
    loops = loops_along(grid, ready)
    still = zero_dynamics(grid.problem, zero_dynamics_rate(grid), is_planned(ready), loops)
    if not ready.deformation.adapts:
        return (still,)
    try:
        own, boxed = (spectrum_near(grid, _believed(grid, ready), d, near=False) for d in (grid.draws[:1], grid.draws))
    except InvalidValue as error:
        return (
            Answer("Do the eigenvalues of the response Jacobian have one sign?", Verdict.UNKNOWN, str(error)),
            still,
        )
    limit = largest_product(grid.problem, ready.deformation, own.eigenvalues)
    gains = (one_sign(own, boxed), gain_admissible(ready.deformation, own, boxed, limit))
    return (_verdict(grid, ready, loops, general), box_converges(loops), *gains, still)


def _verdict(grid: ReviewGrid, ready: Controller, loops: Loops, general: list[Answer]) -> Answer:
    doubts = [f"'{a.question}' is answered no" for a in general if a.verdict == Verdict.NO]
    return converges(grid, ready, loops, doubts)


def _believed(grid: ReviewGrid, controller: Controller) -> np.ndarray:
    return controller.parameters(grid.problem.plant)
