"""Measurement of the whole state, and of the response by an accelerometer or a similar sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Array, DerivativeEstimator, response_names
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal


@dataclass(frozen=True)
class Measured(DerivativeEstimator):
    """State and response as the sensors show them, without delay."""

    @property
    def measures_all(self) -> bool:
        return True

    def measures(self, plant: Plant) -> tuple[str, ...]:
        return tuple(dict.fromkeys(plant.output.elements + response_names(plant)))

    def answers(self, plant: Plant) -> tuple[str, ...]:
        return response_names(plant)

    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        del period, start
        realised = plant.response_signal("realised")
        responses = [seen.elements.index(name) for name in response_names(plant)]

        def step(s: Signals) -> dict[str, Expression]:
            both = getattr(s, seen.name)
            return {plant.output.name: both[: plant.output.size], "realised": both[responses]}

        return Block("estimate", Layout((seen,)), Layout((plant.output, realised)), step)

    @property
    def shows_response(self) -> bool:
        return True

    def weights(self, order: int, period: float) -> Array:
        del order, period
        return np.ones(1)

    def delay(self, order: int, period: float) -> float:
        del order, period
        return 0.0

    def fills(self, order: int) -> int:
        del order
        return 1


EXAMPLES = (Measured(),)
