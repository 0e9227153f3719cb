"""Dead time of a plant: the time that commands and measurements take to arrive.

A queue implements a dead time of (d + phi) control cycles, 0 <= phi < 1: the input that acts in a cycle is

    (1 - phi) u_{k-d} + phi u_{k-d-1},

the mean over the cycle of the delayed, held command; measured values are interpolated in the same way. A computation that
takes a full cycle is one more cycle of input dead time.

A dead time may be live up to a stated longest one, `simulator(..., live=["dead_time.inputs.Q1"])`. The queue then has the length of
the longest, and the place where it is read is data.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca

from fpirhc.errors import Mistakes, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import finite_number
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.functions import entry_at
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.symbolic.live import Number, expressed, is_live, live_numbers, nominal

MOST = 1000  # cycles of dead time
MEASUREMENT = "measurement"  # the name beside those of the inputs
_WHOLE = 1e-9  # of a cycle: what differs from a whole number by less is that number


@dataclass(frozen=True)
class Wait:
    """How long a value waits in a queue.

    Args:
        cycles: delay; it need not be whole.
        room: longest delay that a run may set, in cycles; 0: none is live.
    """

    cycles: Number
    room: float = 0.0

    @property
    def length(self) -> int:
        """Values that the queue holds.

        Raises:
            NotSupported: a live delay without room.
        """
        for path in () if self.room else live_numbers(self.cycles):
            raise NotSupported(
                f"setting '{path}' cannot be live without its longest value, which is the length of a queue; state "
                f"DeadTime(longest={{'{path.rpartition('.')[2]}': ...}})"
            )
        return math.ceil(max(nominal(self.cycles), self.room) - _WHOLE)

    def read(self, past: Expression) -> Expression:
        """Return what entered a queue `cycles` ago; the newest value is its first entry."""
        if is_live(self.cycles):
            return _read_live(past, expressed(self.cycles, past))
        delay = float(self.cycles)
        whole = math.floor(delay + _WHOLE)
        share = max(delay - whole, 0.0) if whole < math.ceil(delay - _WHOLE) else 0.0
        return past[whole] if share == 0 else (1 - share) * past[whole] + share * past[whole + 1]


@dataclass(frozen=True, eq=False)
class DeadTime(Checked):
    """Dead time in seconds.

    Args:
        inputs: dead time by input; zero where not named.
        measurement: dead time of the state and the response. At first the queue holds the start.
        before: commands that are on their way at the start, by input. `Problem(input_before=...)` says the
            same, and also serves problems without dead time.
        longest: longest dead time, by input or "measurement", that a run may set; there is then a queue even where the dead time is
            zero.
    """

    inputs: Mapping[str, float] = field(default_factory=dict)
    measurement: float = 0.0
    before: Mapping[str, float] = field(default_factory=dict)
    longest: Mapping[str, float] = field(default_factory=dict, metadata={"setting": "where given"})

    @property
    def queued(self) -> tuple[str, ...]:
        """Names of the inputs that wait in a queue, and "measurement" where measurements do."""
        late = {**self.inputs, MEASUREMENT: self.measurement}
        return tuple(n for n in dict.fromkeys((*late, *self.longest)) if n in self.longest or nominal(late[n]))

    def wait(self, name: str, period: float) -> Wait:
        """Return how long commands of an input, or measurements, wait."""
        late = self.measurement if name == MEASUREMENT else self.inputs.get(name, 0.0)
        return Wait(late / period, self.longest.get(name, 0.0) / period)

    def measurement_wait(self, period: float) -> Wait | None:
        """Return how long measurements wait; None where there is no queue."""
        return self.wait(MEASUREMENT, period) if MEASUREMENT in self.queued else None

    def check(self, plant: Plant, period: float) -> None:
        """Raise if a name is unknown, or a dead time is negative, not finite, or too long.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes, unit = Mistakes("dead_time"), plant.time_unit
        mistakes.unknown("input", self.inputs, plant.inputs)
        mistakes.unknown("before: input", self.before, plant.inputs)
        mistakes.unknown("longest: input or measurement", self.longest, (*plant.inputs, MEASUREMENT))
        for name, value in self.before.items():
            if not finite_number(value):
                mistakes.add(f"before: '{name}' must be a finite number, got {value!r}")
        for name, value in [*self.inputs.items(), (MEASUREMENT, self.measurement)]:
            if not finite_number(value) or value < 0:
                mistakes.add(f"'{name}' must be a number of at least 0, in {unit}, got {value!r}")
            elif value > MOST * period:
                mistakes.add(
                    f"'{name}' is {value:g} {unit}, more than {MOST} control cycles of {period:g} {unit}; "
                    "use a longer period for the run"
                )
            elif value > self.longest.get(name, value):
                mistakes.add(
                    f"'{name}' is {value:g} {unit}, longer than its stated longest={{'{name}': {self.longest[name]:g}}}"
                )
        for name, value in self.longest.items():
            if not finite_number(value) or not 0 < value <= MOST * period:
                mistakes.add(f"longest: '{name}' must be from above 0 to {MOST} control cycles, got {value!r} {unit}")
        mistakes.raise_if_any()


def delay_block(name: str, source: Signal, target: Signal, waits: Sequence[Wait]) -> Block:
    """Block that delays every entry of `source` by its own number of cycles.

    Args:
        name: of the block.
        source: the signal that is delayed.
        target: the delayed signal; its start value fills the queues.
        waits: how long every entry waits.

    Raises:
        NotSupported: a live delay without a stated longest one.
    """
    lengths = [wait.length for wait in waits]
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
        for k, (wait, n) in enumerate(zip(waits, lengths, strict=True)):
            past = ca.vertcat(now[k], queue[ends[k] : ends[k + 1]])
            delayed.append(wait.read(past))
            if n:  # CasADi's [:0] of one entry is that entry
                queues_next.append(past[:n])
        return {target.name: ca.vertcat(*delayed), f"{queues.name}_next": ca.vertcat(*queues_next)}

    return Block(name, Layout((source,)), Layout((target,)), step, Layout((queues,)))


def _read_live(past: Expression, delay: Expression) -> Expression:
    """`Wait.read` with the delay as data, in the same operations."""
    whole = ca.floor(delay + _WHOLE)
    share = ca.if_else(whole < ca.ceil(delay - _WHOLE), ca.fmax(delay - whole, 0), 0)
    return (1 - share) * entry_at(past, whole) + share * entry_at(past, whole + 1)
