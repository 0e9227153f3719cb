"""Weighted copies of a map with different gains; the weights wander to where the response error is smaller.

    r+ = sum_j w_j G_j(r, f, d),    w_j = max(0, 1 - |j - sigma|),    gains of G_0 ... G_{m-1} in geometric progression.

The weights are a tent over the position sigma (they add up to one), which moves by a constant speed in every cycle. After every
five cycles the sum of |f - d| over them is compared with that over the five before: where it did not decrease, sigma turns round.

The rule acts where the iteration converges. It cannot tell an error that fell because of the gain from one that fell because the
task became easier, so under a smooth task sigma wanders over all gains, over-gained ones too, whose saturated oscillation the sums
do not see: on a plant whose gain jumps it does hardly better than a fixed gain. Wrapped as Damped(Blended(...)) it stays
convergent there. A `Tuned` gain finds its place more closely.

References: T. Várkonyi, PhD thesis, Óbuda University, ch. 7 (fuzzy-like tuning of fixed point transformations), in spirit: the
geometric progression, the ends of the range and the comparison every five cycles are our own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import casadi as ca

from fpirhc.deformation.base import Deformation, smooth_norm
from fpirhc.deformation.wrappers.base import Wrapper
from fpirhc.errors import InvalidValue
from fpirhc.symbolic.layout import Expression, Layout, scalar

_SPAN = 5  # cycles whose errors are added up
_NOTHING = 1e300  # sum of the errors before the first: there is nothing to be compared with
_MOST = 50  # copies: each is computed in every cycle


@dataclass(frozen=True)
class Blended(Wrapper):
    """The wrapped map blended from copies with gains between two bounds, starting at its own gain.

    Parameters:
        map: any deformation that iterates.
        smallest_gain: effective gain of the first copy, at most the map's own.
        largest_gain: of the last copy, the bound that the model guarantees (see `assess_gain`: `sector_limit`).
        copies: m, 2 to 50; each costs one evaluation of the map per cycle.
        speed: of sigma, copies per cycle, below 1.

    Raises:
        InvalidValue: bounds that do not enclose the map's own gain, or are of another sign; copies or speed out of range.
    """

    smallest_gain: float
    largest_gain: float
    copies: int = 5
    speed: float = 0.05

    def __post_init__(self) -> None:
        own = self.map.effective_gain()
        given = f"Blended(smallest_gain={self.smallest_gain!r}, largest_gain={self.largest_gain!r})"
        finite = math.isfinite(self.smallest_gain) and math.isfinite(self.largest_gain)
        if own == 0 or not finite or not self._encloses(own):
            raise InvalidValue(
                f"{given}: expected bounds around the map's own effective gain {own:.4g}; assess_gain(...).sector_limit gives "
                "the larger one"
            )
        if self.smallest_gain == self.largest_gain:
            raise InvalidValue(f"{given}: expected two different bounds; with one gain the map alone does")
        if not (isinstance(self.copies, int) and 2 <= self.copies <= _MOST):
            raise InvalidValue(f"Blended(copies={self.copies!r}): expected a whole number between 2 and {_MOST}")
        if not 0 < self.speed < 1:
            raise InvalidValue(f"Blended(speed={self.speed!r}): expected a number of copies per cycle between 0 and 1")

    def _encloses(self, own: float) -> bool:
        # A rounding error beyond is let through: `with_effective_gain` may make one.
        return 0 < self.smallest_gain / own <= 1 + 1e-12 and self.largest_gain / own >= 1 - 1e-12

    @cached_property
    def maps(self) -> tuple[Deformation, ...]:
        """The copies, smallest gain first."""
        ratio = (self.largest_gain / self.smallest_gain) ** (1 / (self.copies - 1))
        return tuple(self.map.with_effective_gain(self.smallest_gain * ratio**j) for j in range(self.copies))

    @cached_property
    def first_position(self) -> float:
        """The sigma at which the blend has the map's own gain."""
        own, gains = self.map.effective_gain(), [m.effective_gain() for m in self.maps]
        below = max(j for j in range(self.copies - 1) if j == 0 or gains[j] / own <= 1)
        share = (own - gains[below]) / (gains[below + 1] - gains[below])
        return below + min(max(share, 0.0), 1.0)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """Position, direction, the two sums and the cycles in the newer; and what each copy remembers."""
        own = (
            scalar("blend_position", start=self.first_position),
            scalar("blend_direction", start=1.0),
            scalar("blend_sum"),
            scalar("blend_before", start=_NOTHING),
            scalar("blend_cycles"),
        )
        inner = self.map.memory(elements).signals
        return Layout((*own, *(replace(s, name=f"copy{j}_{s.name}") for j in range(self.copies) for s in inner)))

    def shown(self) -> Mapping[str, str]:
        """The position."""
        return {"blend_at": "blend_position"}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the weighted sum of the copies' requests."""
        moved, following = 0 * request, self._moved(response - desired, memory)
        for j, copy in enumerate(self.maps):
            prefix = f"copy{j}_"
            inner = {name.removeprefix(prefix): value for name, value in memory.items() if name.startswith(prefix)}
            wanted, kept = copy.step(request, response, desired, inner)
            moved += ca.fmax(0, 1 - ca.fabs(memory["blend_position"] - j)) * (wanted - request)
            following |= {prefix + name: value for name, value in kept.items()}
        return request + moved, following

    def _moved(self, error: Expression, memory: Mapping[str, Expression]) -> dict[str, Expression]:
        total = memory["blend_sum"] + smooth_norm(error, 1e-12)
        cycles = memory["blend_cycles"] + 1
        full = cycles > _SPAN - 0.5
        # A sum that is not a number has not decreased.
        turns = ca.logic_and(full, ca.logic_not(total < memory["blend_before"]))
        direction = ca.if_else(turns, -memory["blend_direction"], memory["blend_direction"])
        position = memory["blend_position"] + self.speed * direction
        return {
            "blend_position": ca.fmin(ca.fmax(position, 0), self.copies - 1),
            "blend_direction": direction,
            "blend_sum": ca.if_else(full, 0, total),
            "blend_before": ca.if_else(full, total, memory["blend_before"]),
            "blend_cycles": ca.if_else(full, 0, cycles),
        }

    def secant_gain(self) -> float:
        """The blend of the copies' at the start."""
        weights = (max(0.0, 1 - abs(self.first_position - j)) for j in range(self.copies))
        return sum(w * m.secant_gain() for w, m in zip(weights, self.maps, strict=True))

    def largest_step(self) -> float:
        """The largest of the copies'."""
        return max(m.largest_step() for m in self.maps)

    def with_effective_gain(self, gain: float) -> Self:
        """Return the blend around the map with that gain, its bounds in proportion."""
        share = gain / self.map.effective_gain()
        return replace(
            self,
            map=self.map.with_effective_gain(gain),
            smallest_gain=self.smallest_gain * share,
            largest_gain=self.largest_gain * share,
        )


def examples(inner: Deformation) -> tuple[Deformation, ...]:
    """Values for the laws, around any map."""
    return (Blended(inner, smallest_gain=0.5 * inner.effective_gain(), largest_gain=1.5 * inner.effective_gain()),)
