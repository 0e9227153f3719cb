"""The contract of deformations that wrap another one: all that they do not say otherwise is the wrapped map's."""

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
    """Contract: a deformation around `map`, the first field of every wrapper."""

    map: Deformation

    @property
    def inner(self) -> Deformation:
        """The map."""
        return self.map

    @property
    def gain(self) -> float:
        """The map's own gain."""
        return float(getattr(self.map, self.map.gain_name))

    def shown(self) -> Mapping[str, str]:
        """What the map shows."""
        return self.map.shown()

    def effective_gain(self) -> float:
        """The map's own."""
        return self.map.effective_gain()

    def secant_gain(self) -> float:
        """The map's own."""
        return self.map.secant_gain()

    def largest_step(self) -> float:
        """The map's own."""
        return self.map.largest_step()

    def with_effective_gain(self, gain: float) -> Self:
        """Return the same wrapper around the map with that gain."""
        return replace(self, map=self.map.with_effective_gain(gain))


def of_map(wrapper: Wrapper, memory: Mapping[str, Expression], size: int) -> dict[str, Expression]:
    """The part of a wrapper's memory that is the map's own; `size` is the number of coordinates."""
    own = wrapper.map.memory(tuple(f"q{k}" for k in range(size)))
    return {name: memory[name] for name in own.names}


def start_of_map(wrapper: Wrapper, size: int) -> dict[str, Expression]:
    """What the map remembers at the start."""
    own = wrapper.map.memory(tuple(f"q{k}" for k in range(size)))
    return own.split(expression(ca.DM(own.start())))
