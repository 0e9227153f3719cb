"""Dead time of a plant: the time that commands and measurements take to arrive.

A queue implements a dead time of (d + phi) control cycles, 0 <= phi < 1: the input that acts in a cycle is

    (1 - phi) u_{k-d} + phi u_{k-d-1},

the mean over the cycle of the delayed, held command; measured values are interpolated in the same way. A computation that
takes a full cycle is one more cycle of input dead time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca

from fpirhc.errors import Mistakes
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal

MOST = 1000  # cycles of dead time


@dataclass(frozen=True, eq=False)
class DeadTime:
    """Dead time in seconds.

    Args:
        inputs: dead time by input; zero where not named.
        measurement: dead time of the state and the response. At first the queue holds the start.
        before: commands that are on their way at the start, by input; zero where not named.
    """

    inputs: Mapping[str, float] = field(default_factory=dict)
    measurement: float = 0.0
    before: Mapping[str, float] = field(default_factory=dict)

    def commands_before(self, plant: Plant) -> tuple[float, ...]:
        """The commands on their way at the start, one per input."""
        return tuple(float(self.before.get(name, 0.0)) for name in plant.inputs)

    def check(self, plant: Plant, period: float) -> None:
        """Raise if a name is unknown, or a dead time is negative, not finite, or too long.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("dead_time")
        mistakes.unknown("input", self.inputs, plant.inputs)
        mistakes.unknown("before: input", self.before, plant.inputs)
        for name, value in self.before.items():
            if not isinstance(value, int | float) or not math.isfinite(value):
                mistakes.add(f"before: '{name}' must be a finite number, got {value!r}")
        for name, value in [*self.inputs.items(), ("measurement", self.measurement)]:
            if not isinstance(value, int | float) or not math.isfinite(value) or value < 0:
                mistakes.add(f"'{name}' must be a number of seconds of at least 0, got {value!r}")
            elif value > MOST * period:
                mistakes.add(
                    f"'{name}' is {value:g} s, more than {MOST} control cycles of {period:g} s; use a longer period for the run"
                )
        mistakes.raise_if_any()


def delay_block(name: str, source: Signal, target: Signal, cycles: Sequence[float]) -> Block:
    """Block that delays every entry of `source` by its own number of cycles.

    Args:
        name: of the block.
        source: the signal that is delayed.
        target: the delayed signal; its start value fills the queues.
        cycles: delay of every entry; it need not be whole.
    """
    lengths = [math.ceil(c - 1e-9) for c in cycles]
    start = target.start_vector()
    queues = Signal(
        f"{name}_queue",
        tuple(f"{e}@{k}" for e, n in zip(source.elements, lengths, strict=True) for k in range(1, n + 1)),
        start=tuple(float(v) for v, n in zip(start, lengths, strict=True) for _ in range(n)),
    )
    ends = [0]
    for n in lengths:
        ends.append(ends[-1] + n)

    def step(s: Signals) -> dict[str, Expression]:
        now, queue = getattr(s, source.name), getattr(s, queues.name)
        delayed, queues_next = [], []
        for k, (delay, n) in enumerate(zip(cycles, lengths, strict=True)):
            past = ca.vertcat(now[k], queue[ends[k] : ends[k + 1]])
            whole = min(math.floor(delay + 1e-9), n)
            share = max(delay - whole, 0.0) if whole < n else 0.0
            delayed.append(past[whole] if share == 0 else (1 - share) * past[whole] + share * past[whole + 1])
            if n:  # CasADi's [:0] of one entry is that entry
                queues_next.append(past[:n])
        return {target.name: ca.vertcat(*delayed), f"{queues.name}_next": ca.vertcat(*queues_next)}

    return Block(name, Layout((source,)), Layout((target,)), step, Layout((queues,)))
