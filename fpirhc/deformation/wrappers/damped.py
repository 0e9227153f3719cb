"""Shrinks the gain of a map as soon as its errors oscillate, which they do before they diverge.

    s <- (1 - eta) s + eta sgn(h_k' h_{k-1}),      h = f - d,
    s < -0.9, or five errors in a row of alternating sign and growing size:      factor <- 0.7 factor,
    otherwise                                                                    factor <- min(1, 1.001 factor),
    r+ = r + factor (G(r, f, d) - r).

The factor never exceeds one, so no bound from a model is needed. While it is one, the request is the map's own, to the last bit.
A step of a disturbance makes one large error that dies out, and no alternation. White measurement noise alternates too, its
errors having the correlation -a lambda / 2: with a lambda = 1 the factor stays near one (mean 0.98 over 20 000 cycles), with 1.8
it falls to 0.7 in the mean. Where the map is over-gained the factor comes back to the limit of stability again and again, and a
small oscillation each time turns it away.

References: the precursor oscillations of J. K. Tar's group, in spirit; the rule is our own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.deformation.wrappers.base import Wrapper, of_map
from fpirhc.deformation.wrappers.forgetting import forget, growing_in_a_row
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

_OSCILLATES = -0.9
_IN_A_ROW = 5
_SHRINK, _REGROW = 0.7, 1.001
_REST = 8  # cycles for a shrunk gain to show in the sign


@dataclass(frozen=True)
class Damped(Wrapper):
    """The wrapped map with its step shrunk while its errors oscillate.

    Parameters:
        map: any deformation that iterates.
    """

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """The factor, the sign correlation, the rest after a shrinking, the growing errors, the last; and the map's own."""
        own = (
            scalar("damper_factor", start=1.0),
            scalar("damper_sign"),
            scalar("damper_rest"),
            scalar("damper_growing"),
            Signal("damper_error", elements),
        )
        return Layout(own) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        """The factor, and what the map shows."""
        return {"damping_factor": "damper_factor", **self.map.shown()}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + factor (G(r, f, d) - r), and G(r, f, d) itself where the factor is one."""
        inner = of_map(self, memory, request.numel())
        wanted, following = self.map.step(request, response, desired, inner)
        error, before = response - desired, memory["damper_error"]
        seen = forget(memory["damper_sign"], ca.sign(ca.dot(error, before)))
        growing = growing_in_a_row(memory["damper_growing"], error, before)
        diverges = growing > _IN_A_ROW - 0.5
        oscillates = ca.logic_and(seen < _OSCILLATES, memory["damper_rest"] < 0.5)
        shrinks = ca.logic_or(diverges, oscillates)
        regrown = ca.fmin(1, _REGROW * memory["damper_factor"])
        factor = ca.if_else(shrinks, _SHRINK * memory["damper_factor"], regrown)
        own = {
            "damper_factor": factor,
            "damper_sign": seen,
            "damper_rest": ca.if_else(shrinks, _REST, ca.fmax(memory["damper_rest"] - 1, 0)),
            "damper_growing": ca.if_else(diverges, 0, growing),
            "damper_error": error,
        }
        return ca.if_else(factor < 1, request + factor * (wanted - request), wanted), {**own, **following}


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Damped(inner),)
