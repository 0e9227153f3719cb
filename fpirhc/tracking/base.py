"""The contract of tracking laws."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay


@dataclass(frozen=True)
class Feedback:
    """A law that feeds errors back with constant gains, q^(n),Des = q^(n),N + sum of gains times errors.

    gains: of (e_int, e, e', ...) with the integral, of (e, e', ...) without; lowest derivative first.
    bumpless: whether the integral starts so that the first desired response is the nominal one.
    rate: where the law is (d/dt + rate)^m z = 0 with z = e_int or e, and m the number of gains, 1/s; else None.
    """

    gains: tuple[float, ...]
    integral: bool
    bumpless: bool
    rate: float | None = None


class Tracking(ABC):
    """Contract: q^Des from the nominal motion and the measured state.

    A law is two blocks with its memory between them, because what it remembers may depend on what happened to the
    command later in the cycle (an integral must not grow while the command is clipped).
    """

    @property
    def speed(self) -> float | None:
        """The rate, 1/s, that control period and dead time are compared with; None where the law has none."""
        return None

    def feedback(self, order: int) -> Feedback | None:  # noqa: ARG002
        """The law for a coordinate of that relative order, where it is one with constant gains; None elsewhere."""
        return None

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
