"""Dead time of a plant: the time that commands and measurements take to arrive.

A `Queue` of past values implements it. A computation that takes a full cycle is one more cycle of input dead time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import NotNegative, finite_number
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, total
from fpirhc.symbolic.layout import Expression, Layout, Signal


@dataclass(frozen=True, eq=False)
class DeadTime(Checked):
    """Dead time, in the plant's unit of time.

    A part of a cycle is interpolated: over a cycle the plant has the mean of two commands, weighted by their parts of it, and not
    one after the other; a measurement is that between two samples.

    Args:
        inputs: dead time by input; zero where not named. An external plant has it itself, so that it is not simulated.
        measurement: dead time of the state and the response. At first the queue holds the start.
    """

    inputs: Mapping[str, NotNegative] = field(default_factory=dict)
    measurement: NotNegative = 0.0

    @property
    def longest(self) -> float:
        """From a command of the slowest input to its measured response."""
        return max(self.inputs.values(), default=0.0) + self.measurement

    def over(self, period: float) -> DeadTime:
        """Return it without dead times that are below the rounding of a cycle, as .3 - .1 - .2 is."""
        inputs = {n: late for n, late in self.inputs.items() if not 0 < late < WHOLE * period}
        measurement = 0.0 if self.measurement < WHOLE * period else self.measurement
        same = (len(inputs), measurement) == (len(self.inputs), self.measurement)
        return self if same else DeadTime(inputs, measurement)

    def longer(self, percent: float, period: float) -> DeadTime:
        """Return it longer by so many percent, in whole cycles, rounded away from the true one."""

        def changed(time: float) -> float:
            cycles = time / period * (1 + percent / 100) - math.copysign(WHOLE, percent)
            return max((math.ceil if percent > 0 else math.floor)(cycles), 0) * period

        return DeadTime({name: changed(time) for name, time in self.inputs.items()}, changed(self.measurement))

    def input_cycles(self, names: Iterable[str], period: float, later: float = 0.0) -> tuple[int, ...]:
        """Return the dead times of some inputs, later by some cycles, to the nearest whole cycles."""
        return tuple(whole(self.inputs.get(name, 0.0) / period + later) for name in names)

    def measurement_cycles(self, period: float) -> int:
        """Return the dead time of the measurement, to the nearest whole cycle."""
        return whole(self.measurement / period)

    def measurement_wait(self, period: float) -> Queue | None:
        """Return how long measurements wait; None where they do not."""
        return Queue(self.measurement / period) if self.measurement else None

    def check(self, plant: Plant, period: float) -> None:
        """Raise if a name is unknown, or a dead time is too long."""
        mistakes, unit = Mistakes("dead_time"), plant.time_unit
        mistakes.unknown("input", self.inputs, plant.inputs)
        for name, value in {**self.inputs, "measurement": self.measurement}.items():
            if value > MOST * period:
                mistakes.add(
                    f"'{name}' is {value:g} {unit}, more than {MOST} control cycles of {period:g} {unit}; "
                    f"use a longer period for the run{'; is one of the two in ms?' * (unit == 's')}"
                )
        mistakes.raise_if_any()


def delay_block(name: str, source: Signal, target: Signal, waits: Sequence[Queue]) -> Block:
    """Block that delays every entry of `source` by its own number of cycles."""
    queue, kept = Queue(tuple(cycles for wait in waits for cycles in every(wait.cycles))), f"{name}_queue"
    memory = queue.memory(kept, source.elements, tuple(map(float, target.start_vector())))

    def step(s: Signals) -> dict[str, Expression]:
        arrived, later = queue.arrived(s, kept, getattr(s, source.name))
        return {target.name: arrived, **later}

    return Block(name, Layout((source,)), Layout((target,)), step, Layout(memory))


MOST = 1000  # cycles of dead time; the memory has a fixed size
Cycles = float | tuple[float, ...]  # one dead time for all channels, or one for each
WHOLE = 1e-9  # of a cycle: what differs from a whole number by less is that number


@dataclass(frozen=True)
class Queue:
    """Past values of a vector, each entry with a delay of its own; a fraction of a cycle is interpolated.

    A delay of (d + phi) control cycles, 0 <= phi < 1, is the mean over the cycle of the delayed, held value,

        (1 - phi) u_{k-d} + phi u_{k-d-1}.

    The column of past values holds the newest value of every entry first, then the values of the cycle before, and so on.
    """

    cycles: Cycles  # delay of all entries, or a tuple with one per entry

    @property
    def length(self) -> int:
        """Number of cycles that are remembered, the newest included."""
        return max(max(self._shares(c)) for c in every(self.cycles)) + 1

    @property
    def weights(self) -> np.ndarray:
        """Weights of the values of this cycle, the last one, ... in an entry, where all have the same delay."""
        shares = self._shares(max(every(self.cycles)))
        return np.array([shares.get(k, 0.0) for k in range(self.length)])

    def later(self, cycles: int) -> Queue:
        """Return the queue with every delay longer by whole cycles."""
        delays = tuple(c + cycles for c in self.cycles) if isinstance(self.cycles, tuple) else self.cycles + cycles
        return Queue(delays)

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
        if not isinstance(self.cycles, tuple):
            shares = self._shares(self.cycles)
            return total(share * queue[size * k : size * (k + 1)] for k, share in shares.items())
        channels = [self._shares(c) for c in self.cycles]
        entries = (
            total(share * queue[size * k + j] for k, share in shares.items()) for j, shares in enumerate(channels)
        )
        return ca.vertcat(*entries)

    @staticmethod
    def _shares(cycles: float) -> dict[int, float]:
        """Weights of what was pushed k cycles ago."""
        whole = math.floor(cycles + WHOLE)
        part = max(cycles - whole, 0.0) if whole < math.ceil(cycles - WHOLE) else 0.0
        return {place: share for place, share in ((whole, 1 - part), (whole + 1, part)) if share > 0}


def whole(cycles: float) -> int:
    """Return the nearest whole number of cycles; half a cycle is rounded down."""
    return math.floor(cycles + 0.5 - WHOLE)


def every(cycles: Cycles) -> tuple[float, ...]:
    """The dead times as a tuple, one entry where all channels share one."""
    return cycles if isinstance(cycles, tuple) else (cycles,)


def check_cycles(
    owner: str, cycles: Cycles, name: str = "cycles", *, uncertainty: int | None = None, of_model: bool = False
) -> None:
    """Raise for a dead time that is negative, not finite or beyond 1000 cycles, an empty tuple, one wrong by more than itself.

    `of_model`: whether a model is late by it, which parts of a cycle cannot be.
    """
    values = every(cycles)
    if not values or not all(finite_number(c) and 0 <= c <= MOST for c in values):
        raise InvalidValue(
            f"{owner}({name}={cycles!r}): expected a dead time between 0 and {MOST} control cycles, or a tuple with one for "
            "every controlled coordinate"
        )
    shortest = min(values)
    if uncertainty is not None and not 0 <= uncertainty <= math.ceil(shortest):
        raise InvalidValue(
            f"{owner}(uncertainty={uncertainty!r}): expected whole cycles from 0 to {math.ceil(shortest)}, the dead time of "
            f"{shortest:g} rounded up: a dead time cannot be too long by more than itself"
        )
    for value in values if of_model else ():
        low = math.floor(value)
        if abs(value - round(value)) > WHOLE:
            raise InvalidValue(
                f"{owner}({name}={cycles!r}): a model is late by whole control cycles; give {low} or {low + 1} for {value:g}"
            )
