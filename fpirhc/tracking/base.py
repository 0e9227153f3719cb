"""The contract of tracking laws."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from fpirhc.fields.checked import Checked
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay


@dataclass(frozen=True)
class Feedback:
    """A law that feeds errors back with constant gains, q^(n),Des = q^(n),N + sum of gains times errors.

    Args:
        gains: of (e_int, e, e', ...) with the integral, of (e, e', ...) without; lowest derivative first.
        integral: whether the integral of the error is fed back.
        bumpless: whether the integral starts so that the first desired response is the nominal one.
        rate: where the law is (d/dt + rate)^m z = 0 with z = e_int or e, and m the number of gains, 1/s; else None.
    """

    gains: tuple[float, ...]
    integral: bool
    bumpless: bool
    rate: float | None = None


class Tracking(Checked, ABC):
    """Contract: q^Des from the nominal motion and the measured state.

    A law is two blocks with its memory between them, because the memory may depend on the command, which comes later in the cycle
    (an integral must not grow while the command is clipped).
    """

    @property
    def speed(self) -> float | None:
        """The rate, 1/s, to which control period and dead time are compared; None where the law has none."""
        return None

    def feedback(self, order: int) -> Feedback | None:  # noqa: ARG002
        """The law for a coordinate of that relative order; None where its gains are not constant."""
        return None

    def within(self, largest: Sequence[float]) -> Self:  # noqa: ARG002
        """Return the law for inputs with limits: what it remembers forgets a demand that no limits could meet.

        By default the law itself.

        Args:
            largest: response of every controlled coordinate that the limits allow; infinite where they are not finite.
        """
        return self

    @abstractmethod
    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, warm_up, memory) -> (_target_error, desired, ...).

        Where `warm_up` is zero a run begins, and the law must not use its memory.
        """

    @abstractmethod
    def update(self, plant: Plant, period: float) -> Block:
        """Block (_target_error, clipped, ...) -> memory of the law for the next cycle."""

    @abstractmethod
    def delays(self, plant: Plant) -> tuple[Delay, ...]:
        """Signals that the law carries to the next cycle."""
