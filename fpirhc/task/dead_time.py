"""Dead time of a plant: the time that commands and measurements take to arrive.

A queue implements it (`fpirhc.symbolic.queue`). A computation that takes a full cycle is one more cycle of input dead time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca

from fpirhc.errors import Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Finite, NotNegative
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.symbolic.live import nominal
from fpirhc.symbolic.queue import MOST, Queue, room

MEASUREMENT = "measurement"  # the name beside those of the inputs


@dataclass(frozen=True, eq=False)
class DeadTime(Checked):
    """Dead time in seconds.

    Args:
        inputs: dead time by input; zero where not named.
        measurement: dead time of the state and the response. At first the queue holds the start.
        before: commands that are on their way at the start, by input. `Problem(input_before=...)` says the
            same, and also serves problems without dead time.
        longest: longest dead time, by input or "measurement", that a run may set; there is then a queue even where the dead time is
            zero. Twice the dead time where it is not named.
    """

    inputs: Mapping[str, NotNegative] = field(default_factory=dict)
    measurement: NotNegative = 0.0
    before: Mapping[str, Finite] = field(default_factory=dict)
    longest: Mapping[str, float] = field(default_factory=dict, metadata={"setting": "where given"})

    @property
    def queued(self) -> tuple[str, ...]:
        """Names of the inputs that wait in a queue, and "measurement" where measurements do."""
        late = {**self.inputs, MEASUREMENT: self.measurement}
        return tuple(n for n in dict.fromkeys((*late, *self.longest)) if n in self.longest or nominal(late[n]))

    @property
    def at_longest(self) -> DeadTime:
        """The dead time with the longest numbers that a run may set."""
        inputs = {n: self.longest.get(n, late) for n, late in self.inputs.items()}
        return replace(self, inputs=inputs, measurement=self.longest.get(MEASUREMENT, self.measurement))

    def opened(self, paths: tuple[str, ...]) -> DeadTime:
        """Return it with queues of twice the dead time where one becomes live and no longest one is stated; none for zero."""
        late = {**self.inputs, MEASUREMENT: self.measurement}
        names = [path.removeprefix("inputs.") for path in paths]
        more = {n: room(late[n]) for n in names if late.get(n) and n not in self.longest}
        return replace(self, longest={**self.longest, **more}) if more else self

    def wait(self, name: str, period: float) -> Queue:
        """Return the queue in which commands of an input, or measurements, wait."""
        late = self.measurement if name == MEASUREMENT else self.inputs.get(name, 0.0)
        return Queue(late / period, longest=self.longest[name] / period if name in self.longest else None)

    def measurement_wait(self, period: float) -> Queue | None:
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
        for name, value in nominal({**self.inputs, MEASUREMENT: self.measurement}).items():
            if value > MOST * period:
                mistakes.add(
                    f"'{name}' is {value:g} {unit}, more than {MOST} control cycles of {period:g} {unit}; "
                    "use a longer period for the run"
                )
            elif value > self.longest.get(name, value):
                mistakes.add(
                    f"'{name}' is {value:g} {unit}, longer than its stated longest={{'{name}': {self.longest[name]:g}}}"
                )
        for name, value in self.longest.items():
            if not 0 < value <= MOST * period:
                mistakes.add(f"longest: '{name}' must be from above 0 to {MOST} control cycles, got {value!r} {unit}")
        mistakes.raise_if_any()


def delay_block(name: str, source: Signal, target: Signal, waits: Sequence[Queue]) -> Block:
    """Block that delays every entry of `source` by its own number of cycles.

    Args:
        target: the delayed signal; its start value fills the queues.
    """
    lengths = [wait.length - 1 for wait in waits]
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
            delayed.append(wait.delayed(past, 1))
            if n:  # CasADi's [:0] of one entry is that entry
                queues_next.append(past[:n])
        return {target.name: ca.vertcat(*delayed), f"{queues.name}_next": ca.vertcat(*queues_next)}

    return Block(name, Layout((source,)), Layout((target,)), step, Layout((queues,)))
