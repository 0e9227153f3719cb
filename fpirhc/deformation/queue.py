"""Past values of a vector, each entry with a delay of its own; pairing remembers them.

A delay may be live up to a stated longest one: the queue then has the length of the longest, and the place where it is read is
data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.fields.kinds import finite_number
from fpirhc.symbolic.expression import total
from fpirhc.symbolic.functions import ceil, entry_at
from fpirhc.symbolic.layout import Expression
from fpirhc.symbolic.live import expressed, is_live, live_numbers, nominal

MOST = 1000  # cycles of dead time; the memory has a fixed size
Cycles = float | tuple[float, ...]  # one dead time for all channels, or one for each


@dataclass(frozen=True)
class Queue:
    """Delays of the entries of a vector; a fraction of a cycle is interpolated between two cycles.

    The column of past values holds the newest value of every entry first, then the values of the cycle before, and so on.

    Args:
        cycles: delay of all entries, or a tuple with one per entry.
        width: of the triangular mean around the delay, cycles to either side.
        longest: longest delay that a run may set, cycles; None: no delay is live.
    """

    cycles: Cycles
    width: int = 0
    longest: float | None = None

    @property
    def length(self) -> int:
        """Number of cycles that are remembered, the newest included."""
        if self.longest is not None:
            return math.ceil(self.longest) + self.width + 1
        self._refuse_without_room()
        return self._reach(nominal(self.cycles))

    def needed(self, beside: Expression) -> Expression | int:
        """Return how many of them the delays reach back to; `beside` is an expression of the same kind."""
        if not is_live(self.cycles):
            return self._reach(self.cycles)
        ends = [expressed(ceil(c), beside) for c in every(self.cycles)]
        return ca.mmax(ca.vertcat(*ends)) + self.width + 1

    def pushed(self, queue: Expression, newest: Expression) -> Expression:
        """Return the column one cycle later."""
        # Not an empty slice: CasADi's [:0] of one entry is that entry.
        remembered = newest.numel() * (self.length - 1)
        return ca.vertcat(newest, queue[:remembered]) if remembered else newest

    def delayed(self, queue: Expression, size: int) -> Expression:
        """Return what was pushed `cycles` ago, entry by entry; `size` is the number of entries."""
        if is_live(self.cycles):
            each = every(self.cycles) * (1 if isinstance(self.cycles, tuple) else size)
            return ca.vertcat(*(self._read(queue[j::size], c) for j, c in enumerate(each)))
        if not isinstance(self.cycles, tuple):
            shares = self._shares(self.cycles)
            return total(share * queue[size * k : size * (k + 1)] for k, share in shares.items())
        channels = [self._shares(c) for c in self.cycles]
        entries = (
            total(share * queue[size * k + j] for k, share in shares.items()) for j, shares in enumerate(channels)
        )
        return ca.vertcat(*entries)

    def _reach(self, cycles: Cycles) -> int:
        return max(max(self._shares(c)) for c in every(cycles)) + 1

    def _read(self, past: Expression, cycles: float) -> Expression:
        """What was pushed a live number of cycles ago: the sum of `_shares`, in the same operations."""
        delay = expressed(cycles, past)
        whole = ca.floor(delay)
        part, heights = delay - whole, [self._height(j) for j in range(-self.width, self.width + 1)]
        shares = [
            before * part + own * (1 - part) for before, own in zip([0.0, *heights], [*heights, 0.0], strict=True)
        ]
        return total(share * entry_at(past, whole + k - self.width) for k, share in enumerate(shares))

    def _height(self, j: int) -> float:
        """Of the triangle, `j` cycles from its middle."""
        return (1 - abs(j) / (self.width + 1)) / (self.width + 1)

    def _refuse_without_room(self) -> None:
        for path in live_numbers(self.cycles):
            raise NotSupported(
                f"setting '{path}' cannot be live without its longest value, which is the length of a queue; give longest=... "
                "beside cycles=..."
            )

    def _shares(self, cycles: float) -> dict[int, float]:
        """Weights of what was pushed k cycles ago: a triangle over `width` cycles on both sides of `cycles`, interpolated."""
        shares: dict[int, float] = {}
        whole, part = math.floor(cycles), cycles - math.floor(cycles)
        for j in range(-self.width, self.width + 1):
            height = self._height(j)
            for place, share in ((whole + j, height * (1 - part)), (whole + j + 1, height * part)):
                if share > 0:
                    shares[place] = shares.get(place, 0.0) + share
        return shares


def every(cycles: Cycles) -> tuple[float, ...]:
    """The dead times as a tuple, one entry where all channels share one."""
    return cycles if isinstance(cycles, tuple) else (cycles,)


def several(cycles: Cycles) -> tuple[float, ...]:
    """The dead times where each entry has its own; else an empty tuple."""
    return cycles if isinstance(cycles, tuple) else ()


def check_longest(owner: str, longest: float | None, cycles: Cycles) -> None:
    """Raise InvalidValue for a longest dead time that is shorter than one of the dead times, or beyond 1000 cycles."""
    if longest is not None and not max(every(cycles)) <= longest <= MOST:
        raise InvalidValue(
            f"{owner}: cycles={cycles!r} with longest={longest!r}: expected a longest dead time between the dead time and {MOST} "
            "control cycles"
        )


def check_cycles(owner: str, cycles: Cycles, name: str = "cycles") -> None:
    """Raise InvalidValue for a dead time that is negative, not finite, or beyond 1000 cycles, and for an empty tuple."""
    values = every(cycles)
    if not values or not all(finite_number(c) and 0 <= c <= MOST for c in values):
        raise InvalidValue(
            f"{owner}({name}={cycles!r}): expected a dead time between 0 and {MOST} control cycles, or a tuple with one for "
            "every controlled coordinate"
        )


def check_uncertainty(owner: str, uncertainty: int, cycles: Cycles) -> None:
    """Raise InvalidValue for an uncertainty that is no whole number or exceeds the shortest dead time, rounded up."""
    shortest = min(every(cycles))
    if not (
        isinstance(uncertainty, int) and not isinstance(uncertainty, bool) and 0 <= uncertainty <= math.ceil(shortest)
    ):
        raise InvalidValue(
            f"{owner}(uncertainty={uncertainty!r}): expected whole cycles from 0 to {math.ceil(shortest)}, the dead time of "
            f"{shortest:g} rounded up: a dead time cannot be too long by more than itself"
        )
