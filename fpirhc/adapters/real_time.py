"""The clock of the cycles of a device that moves by itself.

A bad answer lasts its cycle, and a cycle that ends more than a period late is one too (`ExternalPlant(holds=...)`): no burst of
commands makes up for it.
"""

from __future__ import annotations

import time as wall
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fpirhc.adapters.names import require


@dataclass
class RealTime:
    """The time of a run by the clock on the wall.

    Args:
        clock: function that returns the wall time, s.
        sleep: function that waits for some seconds.
    """

    clock: Callable[[], float] = wall.monotonic
    sleep: Callable[[float], None] = wall.sleep
    _zero: float | None = None  # the wall time at which the run has time 0

    def begin(self) -> None:
        """The next cycle is the first; what is built before it has no cycle."""
        self._zero = None

    @contextmanager
    def cycle(self, time: float, period: float) -> Iterator[None]:
        """Do what stands in the body, and return at the end of the cycle that has begun at this time of the run.

        Raises:
            InvalidProblem: the cycle ended more than a period late; the run goes on from now.
        """
        if self._zero is None:
            self._zero = self.clock() - time
        try:
            yield
        finally:
            late = self._late(self._zero + time + period, period)
        require(
            late <= period,
            f"the cycle of {period:g} s ended {late:.3g} s late; choose a longer period, or a quicker bus or controller",
        )

    def _late(self, end: float, period: float) -> float:
        """Wait for the end; where it is missed by a period, commands until now would else go out at one instant."""
        assert self._zero is not None
        self.sleep(max(end - self.clock(), 0.0))
        late = self.clock() - end
        if late > period:
            self._zero += late
        return late
