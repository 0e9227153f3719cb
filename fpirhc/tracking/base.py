"""The contract of tracking laws."""

from __future__ import annotations

from abc import ABC, abstractmethod

from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay


class Tracking(ABC):
    """Contract: q^Des from the nominal motion and the measured state.

    A law is two blocks with its memory between them, because what it remembers may depend on what happened to the
    command later in the cycle (an integral must not grow while the command is clipped).
    """

    @abstractmethod
    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, started, memory) -> (_target_error, desired, ...).

        Where `started` is zero a run begins: what is remembered from before counts no more.
        """

    @abstractmethod
    def update(self, plant: Plant, period: float) -> Block:
        """Block (_target_error, clipped, ...) -> what the law remembers for the next cycle."""

    @abstractmethod
    def delays(self, plant: Plant) -> tuple[Delay, ...]:
        """What the law carries to the next cycle."""
