"""The response as the difference of the highest measured derivative, where the whole state is measured.

    f_k = p f_{k-1} + (1 - p) (y^(n-1)_k - y^(n-1)_{k-1}) / T,        p = exp(-T / tau)

Without filter (p = 0) it is the mean response to the last request: the ideal pair. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np

from fpirhc.fields.kinds import Range
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Array, DerivativeEstimator
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

_TAIL = 1e-9  # share of the low-pass's weights that is left out


class _OfHighest(DerivativeEstimator):
    """The difference over the period, through a low-pass with a pole."""

    @abstractmethod
    def pole(self, period: float) -> float:
        """Pole of the low-pass."""

    def measures(self, plant: Plant) -> tuple[str, ...]:
        return plant.output.elements

    def weights(self, order: int, period: float) -> Array:
        """(1 - p) p^(j-1), without the negligible tail."""
        del order
        pole = self.pole(period)
        count = max(1, math.ceil(math.log(_TAIL) / math.log(pole))) if pole > 0 else 1
        return np.asarray((1 - pole) * pole ** np.arange(count))

    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        """Block (state) -> (state, p f + (1 - p) difference over the period)."""
        pole, highest = self.pole(period), [name + "'" * (plant.chains[name] - 1) for name in plant.controlled_names]
        places = [plant.output.elements.index(e) for e in highest]
        first = tuple(map(float, start[places]))
        before = Signal("estimate_before", tuple(seen.elements[p] for p in places), start=first)
        realised, smooth = plant.response_signal("realised"), Signal("estimate_smooth", plant.controlled_names)
        memory = (before, smooth, scalar("estimate_cycles")) if pole else (before,)

        def step(s: Signals) -> dict[str, Expression]:
            state = getattr(s, seen.name)
            newest = state[places]
            response = (newest - s.estimate_before) / period
            results = {plant.output.name: state, "realised": response, "estimate_before_next": newest}
            if not pole:
                return results
            response = ca.if_else(s.estimate_cycles < 1.5, response, pole * s.estimate_smooth + (1 - pole) * response)
            kept = {"estimate_smooth_next": response, "estimate_cycles_next": ca.fmin(s.estimate_cycles + 1, 2)}
            return {**results, "realised": response, **kept}

        return Block("estimate", Layout((seen,)), Layout((plant.output, realised)), step, Layout(memory))


@dataclass(frozen=True)
class VelocityDifference(_OfHighest):
    """Backward difference of the highest measured derivative over the period."""

    def pole(self, period: float) -> float:
        del period
        return 0.0


_TIME_CONSTANT = Range(
    "a positive number of seconds (without a filter use VelocityDifference())", lambda v: 0 < v < math.inf
)


@dataclass(frozen=True)
class LowPassDifference(_OfHighest):
    """The same difference through a first-order low-pass, which begins with the first difference; it is p / (1 - p) cycles late.

    The filtered response is later than the unfiltered desired response. `Filtered` filters their difference instead, and
    `Paired(cycles=...)` compares the response with the request that caused it.

    Args:
        time_constant: tau, s.
    """

    time_constant: Annotated[float, _TIME_CONSTANT]

    def pole(self, period: float) -> float:
        """Pole of the low-pass, exp(-T / tau)."""
        return math.exp(-period / self.time_constant)


EXAMPLES = (VelocityDifference(), LowPassDifference(time_constant=0.01))
