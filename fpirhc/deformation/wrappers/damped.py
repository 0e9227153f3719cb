"""Shrinks the gain of a map when its errors oscillate: errors oscillate before they diverge.

Theory: docs/theory-maps.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.deformation.base import Deformation, Wrapper, forget, growing_in_a_row, memory_of_map
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

_OSCILLATES = -0.9
_IN_A_ROW = 5
_SHRINK, _REGROW = 0.7, 1.001
_REST = 8  # cycles until a shrunk gain shows in the mean sign


@dataclass(frozen=True)
class Damped(Wrapper):
    """The wrapped map with its step shrunk while its errors oscillate.

    Args:
        map: any deformation that iterates.
    """

    def memory(self, elements: tuple[str, ...]) -> Layout:
        own = (
            scalar("damper_factor", start=1.0),
            scalar("damper_sign"),
            scalar("damper_rest"),
            scalar("damper_growing"),
            Signal("damper_error", elements),
        )
        return Layout(own) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        return {"damping_factor": "damper_factor", **self.map.shown()}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + factor (G(r, f, d) - r), and G(r, f, d) itself where the factor is one."""
        inner = memory_of_map(self, memory, request.numel())
        next_request, next_memory = self.map.step(request, response, desired, inner)
        error, before = response - desired, memory["damper_error"]
        sign = forget(memory["damper_sign"], ca.sign(ca.dot(error, before)))
        growing = growing_in_a_row(memory["damper_growing"], error, before)
        diverges = growing > _IN_A_ROW - 0.5
        oscillates = ca.logic_and(sign < _OSCILLATES, memory["damper_rest"] < 0.5)
        shrinks = ca.logic_or(diverges, oscillates)
        regrown = ca.fmin(1, _REGROW * memory["damper_factor"])
        factor = ca.if_else(shrinks, _SHRINK * memory["damper_factor"], regrown)
        own = {
            "damper_factor": factor,
            "damper_sign": sign,
            "damper_rest": ca.if_else(shrinks, _REST, ca.fmax(memory["damper_rest"] - 1, 0)),
            "damper_growing": ca.if_else(diverges, 0, growing),
            "damper_error": error,
        }
        return ca.if_else(factor < 1, request + factor * (next_request - request), next_request), {**own, **next_memory}


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Damped(inner),)
