"""A review of a problem whose controlled outputs have the order 0: what is known before a run, and what is not.

The iteration is on settled values. Its Jacobian J is that of the plant's static map times the inverse of the model's, and a settled
error is multiplied by I - a J in every cycle. Behind a lag, through which the target is paired, more gain is admissible, not less.
"""

from __future__ import annotations

from collections.abc import Mapping

from fpirhc.contraction.gains import assess_gain
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import checked
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.review.answer import Answer, Review, Verdict
from fpirhc.review.commands import commands_inside
from fpirhc.review.gain import gain_admissible
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.inverse import inverse_exists
from fpirhc.review.neighbourhood import spectrum_near
from fpirhc.review.orders import relative_orders
from fpirhc.review.recommended_gain import recommended_gain
from fpirhc.review.signs import one_sign
from fpirhc.review.well_posed import well_posed

_NOT_COVERED = "pole, delay and zero-dynamics checks are not available for outputs of relative order 0"
_LIMIT = 2.0  # of effective gain times eigenvalue, once everything has settled


def controls_order_zero(grid: ReviewGrid) -> bool:
    """Return whether an output of order 0 is controlled."""
    plant = grid.problem.plant
    return 0 in plant.response_orders.values()


def review_of_order_zero(grid: ReviewGrid, controllers: Mapping[str, Controller]) -> Review:
    """Return the answers about a problem whose controlled outputs have the order 0.

    Args:
        grid: points and draws of the problem.
        controllers: by name.
    """
    general = (well_posed(grid), relative_orders(grid), inverse_exists(grid), commands_inside(grid))
    rest = Answer("What do the other questions say?", Verdict.UNKNOWN, _NOT_COVERED, "Run it and compare.")
    return Review((*general, rest), {name: _of(grid, one) for name, one in controllers.items()}, grid.mismatch)


def _of(grid: ReviewGrid, controller: Controller) -> tuple[Answer, ...]:
    try:
        ready = checked(grid.real or grid.problem, controller)
    except FpirhcError as error:
        return (Answer("Does the controller fit the problem?", Verdict.NO, str(error)),)
    if not ready.deformation.adapts:
        return ()
    believed = ready.plant_model(grid.problem).parameters(grid.problem.plant)
    try:
        own, boxed = (spectrum_near(grid, believed, draws, near=False) for draws in (grid.draws[:1], grid.draws))
    except InvalidValue as error:
        return (Answer("Do the eigenvalues of the response Jacobian have one sign?", Verdict.UNKNOWN, str(error)),)
    advice = recommended_gain(ready.deformation, assess_gain(ready.deformation, boxed), _LIMIT / 2, None)
    return (one_sign(own, boxed), gain_admissible(ready.deformation, own, boxed, _LIMIT, advice))
