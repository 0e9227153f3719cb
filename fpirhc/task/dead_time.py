"""Dead time of a plant: the time that commands and measurements take to arrive.

A `Queue` of past values implements it. A computation that takes a full cycle is one more cycle of input dead time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca

from fpirhc.errors import Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Finite, NotNegative
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, total
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.symbolic.live import LiveNumber, ceil, entry_at, expressed, is_live, live_numbers, nominal, not_live

MEASUREMENT = "measurement"  # the name beside those of the inputs


@dataclass(frozen=True, eq=False)
class DeadTime(Checked):
    """Dead time, in the plant's unit of time.

    A part of a cycle is interpolated: over a cycle the plant has the mean of two commands, weighted by their parts of it, and not
    one after the other; a measurement is that between two samples.

    Args:
        inputs: dead time by input; zero where not named.
        measurement: dead time of the state and the response. At first the queue holds the start.
        before: commands that are on their way at the start, by input. `Problem(input_before=...)` says the
            same, and also serves problems without dead time.
        longest: longest dead time, by input or "measurement", that a run may set; there is then a queue even where the dead time is
            zero. Twice the dead time where it is not named.
        outside: the part of `inputs` that an external plant has itself, so that it is not simulated. `Problem` fills it in from
            `ExternalPlant(dead_time=...)`.
    """

    inputs: Mapping[str, NotNegative] = field(default_factory=dict)
    measurement: NotNegative = 0.0
    before: Mapping[str, Finite] = field(default_factory=dict)
    longest: Mapping[str, float] = field(default_factory=dict, metadata={"setting": "where given"})
    outside: Mapping[str, float] = field(default_factory=dict, kw_only=True, repr=False, metadata={"setting": False})

    @cached_property
    def simulated(self) -> DeadTime:
        """The dead time that a run adds: all but the part that the external plant has."""
        if not self.outside:
            return self
        inputs, longest = (
            {n: time - self.outside.get(n, 0.0) for n, time in times.items()} for times in (self.inputs, self.longest)
        )
        return replace(self, inputs=inputs, longest={n: t for n, t in longest.items() if t > 0}, outside={})

    @cached_property
    def all_simulated(self) -> DeadTime:
        """The same dead time where a plant of equations stands for the external one, so that a run adds all of it."""
        return replace(self, outside={}) if self.outside else self

    def behind(self, outside: Mapping[str, float], mistakes: Mistakes) -> DeadTime:
        """Return it with the dead time of an external plant in place of that of the last one; what is simulated stays.

        Args:
            outside: dead time by input; empty: there is no external plant, or it states none.
            mistakes: gets an input whose dead time is stated twice, and differently.
        """
        if dict(outside) == dict(self.outside):
            return self
        own = {n: time for n, time in self.simulated.inputs.items() if time or n not in self.outside}
        twice = {} if self.outside else {n: time for n, time in own.items() if n in outside}
        for name, time in twice.items():
            if time != outside[name]:
                mistakes.add(
                    f"dead_time: of input '{name}' the external plant states {outside[name]!r}, and the problem {time!r}; state it "
                    "once, ExternalPlant(dead_time=...) for what the body has, DeadTime(inputs=...) for what is simulated before it"
                )
        added = {n: time for n, time in own.items() if n not in twice}
        known = {n: added.get(n, 0.0) + outside.get(n, 0.0) for n in {**outside, **added}}
        return replace(self, inputs=known, outside=dict(outside))

    def over(self, period: float) -> DeadTime:
        """Return it without dead times that are below the rounding of a cycle, as .3 - .1 - .2 is."""
        least = _WHOLE * period
        small = [n for n, late in self.inputs.items() if 0 < nominal(late) < least and not is_live(late)]
        measurement = (
            0.0 if 0 < nominal(self.measurement) < least and not is_live(self.measurement) else self.measurement
        )
        if not small and measurement is self.measurement:
            return self
        return replace(self, inputs={n: v for n, v in self.inputs.items() if n not in small}, measurement=measurement)

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
        for name, least in self.outside.items():
            if nominal(self.inputs.get(name, 0.0)) < least - _WHOLE * period:
                mistakes.add(
                    f"'{name}' is {nominal(self.inputs.get(name, 0.0)):g} {unit}, less than the {least:g} {unit} that the external "
                    "plant states; state less there, ExternalPlant(dead_time=...)"
                )
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

    `target`: the delayed signal; its start value fills the queues.
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


MOST = 1000  # cycles of dead time; the memory has a fixed size
Cycles = float | tuple[float, ...]  # one dead time for all channels, or one for each
_WHOLE = 1e-9  # of a cycle: what differs from a whole number by less is that number


@dataclass(frozen=True)
class Queue:
    """Past values of a vector, each entry with a delay of its own; a fraction of a cycle is interpolated.

    A delay of (d + phi) control cycles, 0 <= phi < 1, is the mean over the cycle of the delayed, held value,

        (1 - phi) u_{k-d} + phi u_{k-d-1}.        A delay may be live up to `longest`: the place in the queue is then data.

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
    def live(self) -> bool:
        """Whether a delay is data of a run."""
        return is_live(self.cycles)

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
        if not self.live:
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
        if self.live:
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
        longest = int(nominal(self.cycles)) if not self.live else self.length - 1
        if not longest:
            return state
        columns = ca.horzcat(*(queue[size * k : size * (k + 1)] for k in reversed(range(longest))))
        repeated = (ca.repmat(v, 1, longest) for v in held)
        if not self.live:
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
