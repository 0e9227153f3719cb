"""The contract of deformations that wrap another one: a wrapper has the facts of its map unless it overrides them."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.symbolic.expression import expression
from fpirhc.symbolic.layout import Expression

_FORGETTING = 0.1  # share of the newest sign
_RETURNED = 0.3  # relative distance below which an error counts as equal to the error of two cycles before


@dataclass(frozen=True)
class Wrapper(Deformation, ABC):
    """Contract: a deformation around another one.

    Args:
        map: the wrapped deformation, the first field of every wrapper.
    """

    passes_pair: ClassVar[bool] = False  # whether a model-referenced form inside is given what it compares

    map: Deformation

    @property
    def inner(self) -> Deformation:
        """The wrapped map."""
        return self.map

    @property
    def gain(self) -> float:
        """The map's own gain."""
        return float(getattr(self.map, self.map.gain_name))

    def shown(self) -> Mapping[str, str]:
        """The signals of the map."""
        return self.map.shown()

    def effective_gain(self) -> float:
        """The effective gain of the map."""
        return self.map.effective_gain()

    def secant_gain(self) -> float:
        """The secant gain of the map."""
        return self.map.secant_gain()

    def largest_step(self) -> float:
        """The largest step of the map."""
        return self.map.largest_step()

    def with_effective_gain(self, gain: float) -> Self:
        """Return the same wrapper around the map with that gain."""
        return replace(self, map=self.map.with_effective_gain(gain))


def discrete(wrapper: Wrapper, memory: Mapping[str, Expression], size: int) -> dict[str, Expression]:
    """Return the part of a wrapper's memory that belongs to the map; `size` is the number of coordinates."""
    own = wrapper.map.memory(tuple(f"q{k}" for k in range(size)))
    return {name: memory[name] for name in own.names}


def start_of_map(wrapper: Wrapper, size: int) -> dict[str, Expression]:
    """Return what the map remembers at the start; `size` is the number of coordinates."""
    own = wrapper.map.memory(tuple(f"q{k}" for k in range(size)))
    return own.split(expression(ca.DM(own.start())))


def forget(before: Expression, sign: Expression) -> Expression:
    """Return (1 - eta) before + eta sign, and zero where this is not a number."""
    mean = (1 - _FORGETTING) * before + _FORGETTING * sign
    return ca.if_else(ca.fabs(mean) <= 1, mean, 0)


def growing_in_a_row(
    count: Expression, error: Expression, before: Expression, slow: float = 1.0, fast: float | Expression = 1.0
) -> Expression:
    """Return how many errors in a row alternated in sign and grew; zero when the newest did not.

    An error that grew by less than the factor `fast` counts `slow`.
    """
    size, earlier = ca.sumsqr(error), ca.sumsqr(before)
    weight = ca.if_else(size > fast**2 * earlier, 1, slow)
    return ca.if_else(ca.logic_and(ca.dot(error, before) < 0, size > earlier), count + weight, 0)


def returning_in_a_row(count: Expression, error: Expression, before: Expression, earlier: Expression) -> Expression:
    """Return how many errors in a row alternated in sign and were equal to the error of two cycles before: a two-cycle.

    Saturated two-cycles neither grow nor die out. Errors of white noise are not equal in this way eight times in a row.
    """
    back = ca.sumsqr(error - earlier) < _RETURNED**2 * ca.sumsqr(error)
    return ca.if_else(ca.logic_and(ca.dot(error, before) < 0, back), count + 1, 0)
