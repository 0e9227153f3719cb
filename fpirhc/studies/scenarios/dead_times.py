"""Dead times of drawn plants: those of the problem, or shorter or longer ones, which the controllers do not know.

Another length of a queue is another loop, so all have queues for the longest of them, and one loop serves all.
"""

from __future__ import annotations

from functools import cached_property

from fpirhc.review.grid import is_late, live_paths, roomy, scaled
from fpirhc.task.problem import Problem


class DeadTimes:
    """The problem with its dead times and with others.

    Args:
        of: the problem.
        most: by how many percent they are longer at most; 0: they stay as they are.

    Attributes:
        drawn: whether there are others; there are none without a dead time, nor for a body outside that has its own.
    """

    def __init__(self, of: Problem, most: float) -> None:
        self._of, self._most, self.drawn = of, most, most > 0 and is_late(of) and not of.moves.dead_time
        self._known: dict[float, Problem] = {}

    @cached_property
    def room(self) -> Problem:
        """The problem with its own dead times, and with queues for the longest ones where others are drawn."""
        return roomy(self._of, self._most) if self.drawn else self._of

    @property
    def live(self) -> tuple[str, ...]:
        """Paths of the dead times, which are live in the loop that serves all."""
        return live_paths(self.room) if self.drawn else ()

    def at(self, percent: float) -> Problem:
        """Return the problem with dead times that are longer by so many percent, or shorter; see `fpirhc.review.grid.scaled`."""
        if not self.drawn or not percent:
            return self.room
        if percent not in self._known:
            self._known[percent] = scaled(self.room, percent)
        return self._known[percent]
