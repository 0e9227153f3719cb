"""Leaky pairing: how much leak is needed where the dead time may be wrong by some cycles.

    delta_k = p delta_{k-1} + (1 - p) G(delta_{k-1-d}),

Theory: docs/theory.md.
"""

from __future__ import annotations

import math

import casadi as ca

from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import finite_number
from fpirhc.symbolic.expression import stays
from fpirhc.symbolic.layout import Expression
from fpirhc.task.dead_time import MOST, WHOLE, Cycles, every

_BEYOND = 1.01, 1e-3  # factor and amount by which the default pole exceeds the bound: at the bound nothing is damped


def chosen_pole(gain: float, cycles: Cycles, uncertainty: int | None, pole: float | None) -> float:
    """Return the pole of a leaky pairing: `pole` itself, or for None the one that follows from the gain and the uncertainty."""
    if pole is not None:
        return pole
    error = default_uncertainty(max(every(cycles))) if uncertainty is None else uncertainty
    return default_pole(ca.fmax(abs(gain), 1.0), error)


def leaked(pole: float, before: Expression, deformation: Expression) -> Expression:
    """Return p delta_{k-1} + (1 - p) delta; delta itself without a leak."""
    return deformation if stays(pole, 0.0) else pole * before + (1 - pole) * deformation


def default_uncertainty(cycles: float) -> float:
    """A tenth of the dead time, at least one cycle; 0 without dead time."""
    return max(math.ceil(0.1 * cycles - 1e-9), 1) if cycles > 0 else 0


def default_pole(product: float, uncertainty: float) -> float:
    """The pole of the theorem and a little more, below one; 0 where the dead time is certain."""
    least = _least_pole(product, uncertainty)
    factor, amount = _BEYOND
    return ca.fmin(factor * least + amount, 0.5 * (1 + least)) if uncertainty > 0 else 0.0


def check_cycles(owner: str, cycles: Cycles, name: str = "cycles") -> None:
    """Raise InvalidValue for a dead time that is negative, not finite, or beyond 1000 cycles, and for an empty tuple."""
    values = every(cycles)
    if not values or not all(finite_number(c) and 0 <= c <= MOST for c in values):
        raise InvalidValue(
            f"{owner}({name}={cycles!r}): expected a dead time between 0 and {MOST} control cycles, or a tuple with one for "
            "every controlled coordinate"
        )


def check_whole(owner: str, cycles: Cycles, name: str) -> None:
    """Raise InvalidValue for parts of a cycle, which no model is late by."""
    for value in every(cycles):
        low = math.floor(value)
        if abs(value - round(value)) > WHOLE:
            raise InvalidValue(
                f"{owner}({name}={cycles!r}): a model is late by whole control cycles; give {low} or {low + 1} for {value:g}"
            )


def check_uncertainty(owner: str, uncertainty: int, cycles: Cycles) -> None:
    """Raise InvalidValue for an uncertainty that exceeds the shortest dead time, rounded up."""
    shortest = min(every(cycles))
    if not 0 <= uncertainty <= math.ceil(shortest):
        raise InvalidValue(
            f"{owner}(uncertainty={uncertainty!r}): expected whole cycles from 0 to {math.ceil(shortest)}, the dead time of "
            f"{shortest:g} rounded up: a dead time cannot be too long by more than itself"
        )


def _least_pole(product: float, uncertainty: float) -> float:
    """The least pole that the theorem allows for a product g of gain and plant in (0, 2) and a dead time wrong by m cycles.

    p = (2 c + 1 - sqrt(4 c + 1)) / (2 c) with c = g (2 + g) m^2 / 4, here without cancellation; the product may be open.
    """
    bound = product * (2 + product) * uncertainty**2 / 4
    return 2 * bound / (2 * bound + 1 + ca.sqrt(4 * bound + 1))
