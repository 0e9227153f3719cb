"""Past values of a vector, each entry with a delay of its own; a fraction of a cycle is interpolated.

A delay of (d + phi) control cycles, 0 <= phi < 1, is the mean over the cycle of the delayed, held value,

    (1 - phi) u_{k-d} + phi u_{k-d-1}.        A delay may be live up to `longest`: the place in the queue is then data.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from fpirhc.symbolic.expression import Signals, total
from fpirhc.symbolic.functions import ceil, entry_at
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.symbolic.live import LiveNumber, expressed, is_live, live_numbers, nominal, not_live

MOST = 1000  # cycles of dead time; the memory has a fixed size
Cycles = float | tuple[float, ...]  # one dead time for all channels, or one for each
_WHOLE = 1e-9  # of a cycle: what differs from a whole number by less is that number


@dataclass(frozen=True)
class Queue:
    """Delays of the entries of a vector.

    The column of past values holds the newest value of every entry first, then the values of the cycle before, and so on.
    """

    cycles: Cycles  # delay of all entries, or a tuple with one per entry
    width: int = 0  # of the triangular mean around the delay, cycles to either side
    longest: float | None = None  # longest delay that a run may set, cycles; None: no delay is live

    @classmethod
    def up_to(cls, cycles: Cycles, longest: float) -> Queue:
        """Return the queue with room for the longest delay where one is live, and else for the delays themselves."""
        return cls(cycles, longest=longest if is_live(cycles) else None)

    @property
    def length(self) -> int:
        """Number of cycles that are remembered, the newest included."""
        if self.longest is not None:
            return math.ceil(self.longest - _WHOLE) + self.width + 1
        for path in live_numbers(self.cycles):
            raise not_live(
                [path], "it is the length of a queue; state it as longest=...", " here without its longest value"
            )
        return self._reach(nominal(self.cycles))

    def later(self, cycles: int) -> Queue:
        """Return the queue with every delay longer by whole cycles."""
        delays = tuple(c + cycles for c in self.cycles) if isinstance(self.cycles, tuple) else self.cycles + cycles
        return Queue(delays, self.width, None if self.longest is None else self.longest + cycles)

    def needed(self, beside: Expression) -> Expression | int:
        """Return how many of them the delays reach back to; `beside` is an expression of the same kind."""
        if not is_live(self.cycles):
            return self._reach(nominal(self.cycles))
        ends = [expressed(ceil(c), beside) for c in every(self.cycles)]
        return ca.mmax(ca.vertcat(*ends)) + self.width + 1

    def pushed(self, queue: Expression, newest: Expression) -> Expression:
        """Return the column one cycle later."""
        # Not an empty slice: CasADi's [:0] of one entry is that entry.
        remembered = newest.numel() * (self.length - 1)
        return ca.vertcat(newest, queue[:remembered]) if remembered else newest

    def memory(self, name: str, elements: Sequence[str], start: Sequence[float]) -> tuple[Signal, ...]:
        """Return what is remembered of a signal of every cycle; nothing where no entry waits."""
        names = tuple(f"{e}@{k}" for k in range(1, self.length) for e in elements)
        return (Signal(name, names, start=tuple(start) * (self.length - 1)),) if names else ()

    def arrived(self, s: Signals, name: str, now: Expression) -> tuple[Expression, dict[str, Expression]]:
        """Return the entries whose wait is over in a cycle, and what is remembered under the name of the memory."""
        column, remembered = self.column(s, name, now)
        return (self.delayed(column, now.numel()) if remembered else now), remembered

    def column(self, s: Signals, name: str, now: Expression) -> tuple[Expression, dict[str, Expression]]:
        """Return all values of a cycle, the newest first, and what is remembered under the name of the memory."""
        if self.length <= 1:
            return now, {}
        column = ca.vertcat(now, getattr(s, name))
        return column, {f"{name}_next": column[: now.numel() * (self.length - 1)]}

    def delayed(self, queue: Expression, size: int) -> Expression:
        """Return what was pushed `cycles` ago, entry by entry; `size` is the number of entries."""
        if is_live(self.cycles):
            each = every(self.cycles) * (1 if isinstance(self.cycles, tuple) else size)
            return ca.vertcat(*(self._read(queue[j::size], c) for j, c in enumerate(each)))
        cycles = nominal(self.cycles)
        if not isinstance(cycles, tuple):
            shares = self._shares(cycles)
            return total(share * queue[size * k : size * (k + 1)] for k, share in shares.items())
        channels = [self._shares(c) for c in cycles]
        entries = (
            total(share * queue[size * k + j] for k, share in shares.items()) for j, shares in enumerate(channels)
        )
        return ca.vertcat(*entries)

    def at(self, queue: Expression, size: int, cycles: Expression) -> Expression:
        """Return what was pushed so many cycles ago, all entries alike; the number is known at run time, up to the longest."""
        return ca.vertcat(*(self._read(queue[j::size], cycles) for j in range(size)))

    def driven(
        self, step: ca.Function, state: Expression, queue: Expression, size: int, held: Sequence[Expression]
    ) -> Expression:
        """Return a state after the values that are on their way, the oldest first; the delay is whole and one for all entries.

        Args:
            step: Function (state, value, held...) -> state one cycle later.
            queue: the past values; those that entered less than `cycles` ago are on their way.
        """
        assert not isinstance(self.cycles, tuple)
        longest = int(nominal(self.cycles)) if not is_live(self.cycles) else self.length - 1
        if not longest:
            return state
        columns = ca.horzcat(*(queue[size * k : size * (k + 1)] for k in reversed(range(longest))))
        repeated = (ca.repmat(v, 1, longest) for v in held)
        if not is_live(self.cycles):
            return step.mapaccum("fpirhc_driven", longest)(state, columns, *repeated)[:, -1]
        # Where fewer values are on their way than the queue holds, the first steps leave the state as it is.
        x, u, due = ca.SX.sym("x", state.numel()), ca.SX.sym("u", size), ca.SX.sym("due")
        same = [ca.SX.sym(f"held{k}", v.numel()) for k, v in enumerate(held)]
        one = ca.Function("fpirhc_due", [x, u, *same, due], [ca.if_else(due, step(x, u, *same), x)])
        acts = expressed(self.cycles, state) > ca.DM(list(reversed(range(longest)))).T
        return one.mapaccum("fpirhc_driven", longest)(state, columns, *repeated, acts)[:, -1]

    def _reach(self, cycles: Cycles) -> int:
        return max(max(self._shares(c)) for c in every(cycles)) + 1

    def _read(self, past: Expression, cycles: float | Expression) -> Expression:
        """What was pushed a live number of cycles ago: the sum of `_shares`, in the same operations."""
        delay = expressed(cycles, past) if isinstance(cycles, float | int | LiveNumber) else cycles
        whole = ca.floor(delay + _WHOLE)
        part = ca.if_else(whole < ca.ceil(delay - _WHOLE), ca.fmax(delay - whole, 0), 0)
        heights = [self._height(j) for j in range(-self.width, self.width + 1)]
        shares = [
            before * part + own * (1 - part) for before, own in zip([0.0, *heights], [*heights, 0.0], strict=True)
        ]
        return total(share * entry_at(past, whole + k - self.width) for k, share in enumerate(shares))

    def _height(self, j: int) -> float:
        """Of the triangle, `j` cycles from its middle."""
        return (1 - abs(j) / (self.width + 1)) / (self.width + 1)

    def _shares(self, cycles: float) -> dict[int, float]:
        """Weights of what was pushed k cycles ago: a triangle over `width` cycles on both sides of `cycles`, interpolated."""
        shares: dict[int, float] = {}
        whole = math.floor(cycles + _WHOLE)
        part = max(cycles - whole, 0.0) if whole < math.ceil(cycles - _WHOLE) else 0.0
        for j in range(-self.width, self.width + 1):
            height = self._height(j)
            for place, share in ((whole + j, height * (1 - part)), (whole + j + 1, height * part)):
                if share > 0:
                    shares[place] = shares.get(place, 0.0) + share
        return shares


def room(delay: float) -> float:
    """Return the longest delay that a run may set where none is stated: twice the delay of the build."""
    return 2 * delay


def longest_of(longest: float | None, cycles: Cycles, paths: Sequence[str]) -> float | None:
    """Return the longest delay of a queue whose `cycles` may become live: the stated one, or else twice the delay."""
    live = any(path.startswith("cycles") for path in paths)
    return max(1.0, room(max(every(cycles)))) if live and longest is None else longest


def every(cycles: Cycles) -> tuple[float, ...]:
    """The dead times as a tuple, one entry where all channels share one."""
    return cycles if isinstance(cycles, tuple) else (cycles,)


def several(cycles: Cycles) -> tuple[float, ...]:
    """The dead times where each entry has its own; else an empty tuple."""
    return cycles if isinstance(cycles, tuple) else ()
