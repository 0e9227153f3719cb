"""Waiting for the end of a control cycle, for bodies that move by themselves."""

from __future__ import annotations

import time as wall
from collections.abc import Callable
from dataclasses import dataclass


@dataclass
class RealTime:
    """The time of a run by the clock on the wall.

    Args:
        clock: function that returns the wall time, s.
        sleep: function that waits for some seconds.
    """

    clock: Callable[[], float] = wall.monotonic
    sleep: Callable[[float], None] = wall.sleep
    _begin: float = 0.0

    def begin(self) -> None:
        """Now is time 0 of the run."""
        self._begin = self.clock()

    def wait_until(self, time: float) -> None:
        """Return at this time of the run, at once where it has passed."""
        self.sleep(max(self._begin + time - self.clock(), 0.0))
