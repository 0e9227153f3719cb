"""The contract of deformations that wrap another one: a wrapper has the facts of its map unless it overrides them."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.symbolic.expression import expression
from fpirhc.symbolic.layout import Expression


@dataclass(frozen=True)
class Wrapper(Deformation, ABC):
    """Contract: a deformation around another one.

    Args:
        map: the wrapped deformation, the first field of every wrapper.
    """

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


def of_map(wrapper: Wrapper, memory: Mapping[str, Expression], size: int) -> dict[str, Expression]:
    """Return the part of a wrapper's memory that belongs to the map; `size` is the number of coordinates."""
    own = wrapper.map.memory(tuple(f"q{k}" for k in range(size)))
    return {name: memory[name] for name in own.names}


def start_of_map(wrapper: Wrapper, size: int) -> dict[str, Expression]:
    """Return what the map remembers at the start; `size` is the number of coordinates."""
    own = wrapper.map.memory(tuple(f"q{k}" for k in range(size)))
    return own.split(expression(ca.DM(own.start())))
