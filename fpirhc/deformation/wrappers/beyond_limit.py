"""A map whose gain may lie beyond the limit of its iteration: what is refused everywhere else is asked for here.

A saturating map beyond its limit ends in a bounded oscillation, which is worth seeing; a map without saturation diverges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

from fpirhc.deformation.base import Deformation, Iteration, Wrapper
from fpirhc.symbolic.layout import Expression, Layout


@dataclass(frozen=True)
class BeyondLimit(Wrapper):
    """The map as it is, at any gain of the right sign.

    Args:
        map: the wrapped deformation.
    """

    passes_pair: ClassVar[bool] = True

    @property
    def iteration(self) -> Iteration:
        return replace(self.map.iteration, limited=False)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        return self.map.memory(elements)

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        return self.map.step(request, response, desired, memory)


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (BeyondLimit(inner),)
