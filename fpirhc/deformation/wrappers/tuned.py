"""Tunes the gain of a map on line, from the sign of successive response errors.

    s <- (1 - eta) s + eta sgn(h_k' h_{k-1}),      h = f - d,
    s < -0.5: the step is too long, factor <- 0.7 factor;     s > 0.3: too short, factor <- min(1.05 factor, largest),
    five errors in a row of alternating sign and growing size: too long at once,
    r+ = r + factor (G(r, f, d) - r).

In white measurement noise successive errors have the correlation -a lambda/2, so the rule settles where the effective gain times
the plant's gain is near one, noise or not. The sign is used and not the product, because a saturated two-cycle (small, large,
small, large) has no correlation of its amplitudes. The cap must come from a model of the plant: without one the tuner probes
until the loop oscillates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.deformation.wrappers.base import Wrapper, of_map
from fpirhc.deformation.wrappers.forgetting import forget, growing_in_a_row
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

_TOO_LONG, _TOO_SHORT = -0.5, 0.3
_SHRINK, _GROW = 0.7, 1.05
_IN_A_ROW = 5
_REST = 8  # cycles without a change after each change


@dataclass(frozen=True)
class Tuned(Wrapper):
    """The wrapped map with its step scaled on line.

    Parameters:
        map: any deformation that iterates.
        largest_gain: cap of the effective gain, the bound that the model guarantees (see `assess_gain`: `sector_limit`).

    Raises:
        InvalidValue: a cap that is not positive in the direction of the map's own gain, or below it.
    """

    largest_gain: float

    def __post_init__(self) -> None:
        gain = self.map.effective_gain()
        if gain == 0 or not math.isfinite(self.largest_gain) or self.largest_gain / gain < 1:
            raise InvalidValue(
                f"Tuned(largest_gain={self.largest_gain!r}): expected a bound beyond the map's own effective gain {gain:.4g}; "
                "assess_gain(...).sector_limit gives one. A tuner without a bound probes until the loop oscillates"
            )

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """The factor, the sign correlation, the rest after a change, the last error; and the map's own."""
        own = (
            scalar("tuner_factor", start=1.0),
            scalar("tuner_sign"),
            scalar("tuner_rest"),
            scalar("tuner_growing"),
            Signal("tuner_error", elements),
        )
        return Layout(own) + self.map.memory(elements)

    def shown(self) -> Mapping[str, str]:
        """The factor, and what the map shows."""
        return {"gain_factor": "tuner_factor", **self.map.shown()}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return r + factor (G(r, f, d) - r)."""
        inner = of_map(self, memory, request.numel())
        wanted, following = self.map.step(request, response, desired, inner)
        factor, error = memory["tuner_factor"], response - desired
        seen = forget(memory["tuner_sign"], ca.sign(ca.dot(error, memory["tuner_error"])))
        growing = growing_in_a_row(memory["tuner_growing"], error, memory["tuner_error"])
        diverges = growing > _IN_A_ROW - 0.5
        resting = memory["tuner_rest"] > 0.5
        largest = self.largest_gain / self.map.effective_gain()
        changed = ca.if_else(
            seen < _TOO_LONG, _SHRINK * factor, ca.if_else(seen > _TOO_SHORT, ca.fmin(_GROW * factor, largest), factor)
        )
        kept = ca.if_else(diverges, _SHRINK * factor, ca.if_else(resting, factor, changed))
        rest = ca.if_else(
            ca.logic_or(diverges, ca.logic_and(ca.logic_not(resting), changed != factor)),
            _REST,
            ca.fmax(memory["tuner_rest"] - 1, 0),
        )
        own = {"tuner_factor": kept, "tuner_sign": seen, "tuner_rest": rest, "tuner_error": error}
        own["tuner_growing"] = ca.if_else(diverges, 0, growing)
        return request + factor * (wanted - request), {**own, **following}

    def largest_step(self) -> float:
        """The map's, times the largest factor."""
        return self.map.largest_step() * self.largest_gain / self.map.effective_gain()

    def with_effective_gain(self, gain: float) -> Self:
        """Return the tuner around the map with that gain, with the cap in the same proportion."""
        return replace(
            self,
            map=self.map.with_effective_gain(gain),
            largest_gain=self.largest_gain * gain / self.map.effective_gain(),
        )


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Tuned(inner, largest_gain=1.2 * inner.effective_gain()),)
