"""The gate in front of a controller: a bad sample is a skipped cycle. Theory: docs/theory.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.controllers.base import clip
from fpirhc.status import Status
from fpirhc.symbolic.block import GAP, GAPS, LONG, SETTLING, Block, Composite, call
from fpirhc.symbolic.driver import every_finite, finite, kept_if_finite
from fpirhc.symbolic.expression import FINITE, Signals, expression, kind
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import Derived, Values
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

AGAIN = 100 * FINITE  # time of a cycle that is given once more: no number that fits, and no cycle that is missing
BRIDGED = 50  # cycles: the longest gap that is bridged, where nobody states another
# In the memory: cycles since the last sample; -1 before the first one.
MISSING = Signal("missing_cycles", start=(-1.0,))
_STILL = Signal("still_settling")  # in the memory: cycles for which what was learned is held


Counts: TypeAlias = dict[str, Expression]


@dataclass(frozen=True)
class Gap:
    """How many cycles went by without a sample, and what the next sample is told.

        sample missing      the count goes up, and what is a memory of the passing time goes on: queues, filters, observers
        the next sample     estimators and queues are moved over the gap (`fpirhc.symbolic.block`); status BRIDGED
        after a long gap    estimators begin anew with their derivatives, and what was learned is held until their windows hold
                            samples of now alone, as after a start; status SETTLING

    Args:
        bridged: number of missing cycles up to which a gap is bridged.
        settles: number of samples after a long gap that a response needs: that of the start, and what a filter forgets in.
    """

    bridged: int
    settles: float

    @property
    def memory(self) -> tuple[Signal, ...]:
        """Cycles since the last sample, and cycles for which what was learned is held."""
        return (MISSING, _STILL)

    def counts(self, s: Signals, *, trusted: bool) -> Counts:
        """Return the remembered counts; those that a memory cannot have held are those of the start.

        Args:
            s: signals of the cycle.
            trusted: whether nobody else can have written the memory.
        """
        missing, still = getattr(s, MISSING.name), getattr(s, _STILL.name)
        if trusted:
            return {MISSING.name: missing, _STILL.name: still}
        good = ca.logic_and(ca.fabs(missing) <= self.bridged + 1, ca.fabs(still) <= self.settles)
        return {MISSING.name: ca.if_else(good, missing, -1), _STILL.name: ca.if_else(good, still, 0)}

    def passes(self, counts: Counts, time: Expression) -> Expression:
        """Return whether a cycle without a sample is one of a gap: there has been a sample, and the cycle is a new one."""
        return ca.logic_and(counts[MISSING.name] > -0.5, ca.logic_not(time >= AGAIN))

    def seen(self, counts: Counts) -> Counts:
        """Return what the step is told, by name of its signal."""
        missing = counts[MISSING.name]
        long = missing > self.bridged + 0.5
        settling = ca.if_else(long, self.settles, ca.fmax(counts[_STILL.name] - 1, 0)) if self.settles else 0.0
        return {GAP.name: ca.if_else(long, LONG, ca.fmax(missing, 0)), SETTLING.name: expression(settling)}

    def status(self, status: Expression, told: Counts) -> Expression:
        """Return the status of a cycle with a sample: that of the step, unless it is OK and a gap came before."""
        bridged = ca.if_else(told[GAP.name] > 0.5, int(Status.BRIDGED), status)
        gap = ca.if_else(told[SETTLING.name] > 0.5, int(Status.SETTLING), bridged)
        return ca.if_else(status == int(Status.OK), gap, status)

    def remembered(self, fits: Expression, passes: Expression, counts: Counts, told: Counts) -> Counts:
        """Return the counts one cycle later, by name."""
        missing = counts[MISSING.name]
        more = ca.if_else(passes, ca.fmin(missing + 1, self.bridged + 1), missing)
        still = ca.if_else(fits, told[SETTLING.name], counts[_STILL.name])
        return {MISSING.name: ca.if_else(fits, 0, more), _STILL.name: still}


def gap_of(problem: Problem, bridged: int) -> Gap:
    """Return the gap counter of a problem's steps.

    `problem`: of the steps; where state and response are measured as they are, nothing settles.
    """
    if not problem.sensing.estimates:
        return Gap(bridged, 0.0)
    settling = problem.sensing.settling_cycles(problem.plant, problem.period)
    return Gap(bridged, float(problem.longest_warm_up + settling))


def across_gaps(step: Composite) -> Composite:
    """Return a controller's step as it is where samples may be lost."""
    lossy = step.bridged_if_any
    return step if lossy is None else lossy()


FAILED = "not_finite"  # in the memory: steps in a row that were not finite, of samples that fit
PATIENCE = 10  # such steps before one is tried with the memory of the start


def outcome(
    memory_next: Expression,
    memory: Expression,
    command: Expression,
    trace: Expression,
    layout: Layout,
    ran: Expression,
    *,
    opaque: bool,
) -> tuple[Expression, Expression]:
    """Return (memory to keep, whether the step is fine): memory and command are finite, and no status says that something was not.

    `ran`: whether the results are to be kept where they are fine. `opaque`: whether the step is a graph of calls.
    """
    said = expression(1.0) if "status" not in layout else trace[layout.slice("status")] != int(Status.NON_FINITE)
    if not opaque:
        fine = ca.logic_and(every_finite(ca.vertcat(memory_next, command)), said)
        return ca.if_else(ca.logic_and(ran, fine), memory_next, memory), fine
    good = ca.logic_and(ca.mmin(ca.fabs(command) <= FINITE), said)
    kept, finite = kept_if_finite(memory_next, memory, ca.logic_and(ran, good))
    return kept, ca.logic_and(finite, good)


def counted(failed: Expression, fits: Expression, fine: Expression) -> Expression:
    """Return the count of the next cycle: bad samples leave it, and after a trial it begins anew; NaN counts as none."""
    more = ca.if_else(failed < PATIENCE - 0.5, failed + 1, 0)
    return ca.if_else(fits, ca.if_else(fine, 0, more), ca.if_else(failed < PATIENCE + 0.5, failed, 0))


def is_trial(failed: Expression) -> Expression:
    """Return whether this cycle is tried with the memory of the start; a count that cannot be, after a flipped bit, is none."""
    return ca.fabs(failed - PATIENCE) < 0.5


def was_skipped(status: Expression) -> Expression:
    """Return whether a cycle of this status was skipped: its sample, its time or its step was not good."""
    bad = ca.logic_or(status == int(Status.BAD_SAMPLE), status == int(Status.NON_FINITE))
    return ca.logic_or(bad, status == int(Status.BAD_TIME))


HELD = "held_command"  # in the memory: the command that a skipped cycle repeats
TAKEN = "taken"  # time stamp of a sample
LOST = scalar("lost_sample")  # whether a simulated sample is lost, which on a machine is one that is not finite
_SAMPLE = ("time", "state", "output", "realised", "measured", "arrived", TAKEN, LOST.name)
INNER = "controller_memory"  # in the memory: that of a graph as one signal


@dataclass(frozen=True, eq=False)
class _Judged:
    """What a sample and the gate's memory say."""

    fits: ca.SX  # whether the sample fits
    held: ca.SX  # the last command
    stored: ca.SX  # of the last good sample, which may be this one
    counts: Counts  # of gaps, by name; none where no sample can be lost
    told: Counts  # what the step is told, by name
    passes: Expression  # whether a cycle without a sample is one of a gap


def _scalar(name: str, symbols: Sequence[ca.SX], results: Sequence[Expression]) -> ca.Function:
    return ca.Function(f"fpirhc_gate_{name}", [*symbols], ca.cse([ca.densify(r) for r in results]))


@dataclass(frozen=True, eq=False)
class Gate:
    """The gate around a controller's step."""

    problem: Problem  # that the step is composed for
    inner: Composite  # the step of a controller, with the output 'command'
    # what is always good and not checked, such as the 'time' of a simulated clock, or the 'memory' that a loop keeps
    trusted: Sequence[str] = ()
    # intervals (lower, upper) by column of the sample, "state.q1" or "realised.q1"; every finite number fits where there is none
    ranges: Mapping[str, Interval] = field(default_factory=dict)
    loses: bool = False  # whether the step also reads `LOST`
    # s; where given, the step also reads 'taken', the time stamp of the sample, which must be later than the last one's,
    # not later than the time, and not older than this. None: time stamps are not looked at.
    max_age: float | None = None
    gap: Gap | None = None  # counts missing cycles; None: no sample can be lost

    @cached_property
    def reads(self) -> Layout:
        """What the step reads: as the controller, and the time stamp of the sample where its age counts."""
        own = Layout((*(s for s in self.inner.reads.signals if s not in GAPS), *([LOST] if self.loses else [])))
        return own if self.max_age is None else own + Layout((scalar(TAKEN, "s"),))

    @cached_property
    def sample(self) -> Layout:
        """The signals of one sample that are checked."""
        return Layout(tuple([s for s in self.reads.signals if s.name in _SAMPLE and s.name not in self.trusted]))

    @cached_property
    def stored(self) -> Layout:
        """The signals of the last good sample that are kept: all for a graph, and the time stamp that the next one must exceed."""
        return Layout(tuple([s for s in self.sample.signals if self.inner.opaque or s.name == TAKEN]))

    @property
    def memory(self) -> Layout:
        """What the gate keeps, and the controller's memory."""
        return self.kept + self.controller_memory

    @cached_property
    def kept(self) -> Layout:
        """The last command, what is kept of the last good sample, and the counts of failed steps and gaps."""
        plant = self.problem.plant
        starts = {plant.output.name: tuple(map(float, self.problem.start_output)), TAKEN: (-FINITE,)}
        starts[plant.state.name] = tuple(map(float, self.problem.start_state))
        first = self.problem.inputs_before
        held = Signal(HELD, plant.input.elements, plant.input.units, tuple(map(float, first)))
        good = [replace(s, name=f"good_{s.name}", start=starts.get(s.name, s.start)) for s in self.stored.signals]
        failed = [] if "memory" in self.trusted else [scalar(FAILED)]
        counts = self.gap.memory if self.gap is not None else ()
        return Layout((held, *good, *failed, *counts))

    @cached_property
    def controller_memory(self) -> Layout:
        """The controller's memory; of a graph as one signal, because a graph copies every signal of a long memory one by one."""
        memory = self.inner.memory
        if not self.inner.opaque:
            return memory
        return Layout((Signal(INNER, memory.columns, memory.units, tuple(map(float, memory.start())), memory.kinds),))

    def named(self, memory: Layout) -> Layout:
        """Return a layout with the controller's memory under the names of its signals, where it is one signal there."""
        whole = {INNER: self.inner.memory.signals}
        return Layout(tuple(s for signal in memory.signals for s in whole.get(signal.name, (signal,))))

    def block(self) -> Block:
        """Return the step behind the gate as one block: (sample, parameters) -> the controller's trace."""
        trace, before, after = self.inner.trace, self._before(), self._after()
        status = ["status"] if "status" in trace else []

        def step(s: Signals) -> dict[str, Expression]:
            now, own = ca.vertcat(*(getattr(s, n) for n in self.sample.names)), self.kept.join(vars(s))
            fits, column, passes = before(now, own, s.time if self.gap is not None else 0)
            told = self._told.split(column)
            sample = [told[r] if r in told else getattr(s, r) for r in self.inner.reads.names]
            memory = self.controller_memory.join(vars(s))
            usable = expression(1.0)
            if "memory" not in self.trusted:
                failed = is_trial(getattr(s, FAILED))
                usable = ca.logic_and(finite(memory, opaque=self.inner.opaque), ca.logic_not(failed))
            memory_next, shown, command, fine = self._stepped(fits, usable, memory, sample, passes)
            values = trace.split(shown)
            said = ca.vertcat(*(values[n] for n in status))
            ended, own_next = after(now, own, s.time if self.gap is not None else 0, usable, fine, said, command)
            kept = self.kept.split(own_next)
            remembered = {**self.controller_memory.split(memory_next), **kept}
            values |= dict.fromkeys(status, ended)
            return {**values, "command": kept[HELD], **{f"{m}_next": v for m, v in remembered.items()}}

        derived = self._derived if self.inner.derived_if_any else None
        opaque, inside = self.inner.opaque, self.inner
        return Block("gate", self.reads, trace, step, self.memory, opaque=opaque, derived=derived, inside=inside)

    def _derived(self, values: Values) -> Derived:
        """What follows from live settings, with the controller's memory as this block has it."""
        inner = self.inner.derived(values)
        if not self.inner.opaque:
            return inner
        return replace(inner, memory=lambda: {INNER: self.inner.memory.pack(inner.memory())})

    @cached_property
    def _told(self) -> Layout:
        """What the step is told in place of what it reads: the last good sample where it is a graph, and how long a gap was."""
        last = self.stored.signals if self.inner.opaque else ()
        return Layout((*last, *(GAPS if self.gap is not None else ())))

    def _before(self) -> ca.Function:
        """Function (sample, kept, time) -> (whether the sample fits, what the step is told, whether time passes).

        This and `_after` are scalar code: a graph would pass over these few numbers one operation after the other.
        """
        symbols, judged = self._judged
        return _scalar("before", symbols, [judged.fits, self._told.join(judged.told), judged.passes])

    def _after(self) -> ca.Function:
        """Function (sample, kept, time, usable, fine, status, command) -> (status, kept one cycle later)."""
        symbols, judged = self._judged
        own, status, gap = self.kept.split(symbols[1]), ca.SX.sym("status", int("status" in self.inner.trace)), self.gap
        usable, fine, command = (
            ca.SX.sym(n, k) for n, k in (("usable", 1), ("fine", 1), ("command", judged.held.numel()))
        )
        fits, ran = judged.fits, ca.logic_and(judged.fits, fine)
        following = {HELD: ca.if_else(ran, command, judged.held)}
        following |= {
            f"good_{n}": ca.if_else(fine, v, own[f"good_{n}"]) for n, v in self.stored.split(judged.stored).items()
        }
        following |= {FAILED: counted(own[FAILED], fits, fine)} if FAILED in own else {}
        ended = status
        if gap is not None:
            ended = gap.status(status, judged.told) if status.numel() else status
            following |= gap.remembered(ran, judged.passes, judged.counts, judged.told)
        ended = ca.if_else(usable, ended, int(Status.RESTARTED))
        ended = ca.if_else(fits, ca.if_else(fine, ended, int(Status.NON_FINITE)), int(Status.BAD_SAMPLE))
        return _scalar("after", [*symbols, usable, fine, status, command], [ended, self.kept.join(following)])

    @cached_property
    def _judged(self) -> tuple[list[ca.SX], _Judged]:
        """Symbols of (sample, kept, time), and what they say."""
        inputs = self.problem.plant.input.size
        sample, own, time = ca.SX.sym("sample", self.sample.size), ca.SX.sym("kept", self.kept.size), ca.SX.sym("time")
        values = self.kept.split(own)
        held = values[HELD]
        good = ca.vertcat(ca.SX(0, 1), *(values[f"good_{n}"] for n in self.stored.names))
        command, last = held, good
        trusted = "memory" in self.trusted
        if not trusted:
            names = (HELD, *(f"good_{n}" for n in self.stored.names))
            start = ca.DM(np.concatenate([self.kept[n].start_vector() for n in names]))
            column = ca.vertcat(held, good)
            column = ca.if_else(every_finite(column), column, start)
            command = clip(column[:inputs], *self.problem.limits.input_bounds(self.problem.plant))
            last = ca.vertsplit(column, [0, inputs, column.numel()])[1]  # CasADi's empty slice is a row
        fits = ca.logic_and(self._possible(sample, last), self._inside(sample))
        now = ca.vertcat(ca.SX(0, 1), *(sample[self.sample.slice(n)] for n in self.stored.names))
        stored = ca.if_else(fits, now, last)
        counts: Counts = {} if self.gap is None else self.gap.counts(Signals(values), trusted=trusted)
        told = self.stored.split(stored) | ({} if self.gap is None else self.gap.seen(counts))
        passes = ca.SX(0) if self.gap is None else self.gap.passes(counts, time)
        return [sample, own, time], _Judged(fits, command, stored, counts, told, passes)

    def _possible(self, sample: Expression, good: Expression) -> Expression:
        """Whether every entry is finite, and the time stamp is new."""
        possible = every_finite(sample)
        if self.max_age is None:
            return possible
        time, taken = (sample[self.sample.slice(n)] for n in ("time", TAKEN))
        fresh = ca.logic_and(
            taken > good[self.stored.slice(TAKEN)], ca.logic_and(taken <= time, time - taken <= self.max_age)
        )
        return ca.logic_and(possible, fresh)

    def _inside(self, sample: Expression) -> Expression:
        """Whether every entry is inside its interval, and no sample is lost; NaN is inside none."""
        inside: Expression = ca.SX(1)
        for k, column in enumerate(self.sample.columns):
            lower, upper = (-np.inf, 0.0) if column == LOST.name else self.ranges.get(column, (-np.inf, np.inf))
            inside = ca.logic_and(inside, sample[k] >= lower) if np.isfinite(lower) else inside
            inside = ca.logic_and(inside, sample[k] <= upper) if np.isfinite(upper) else inside
        return inside

    def _stepped(
        self, fits: Expression, usable: Expression, memory: Expression, sample: Sequence[Expression], passes: Expression
    ) -> tuple[Expression, Expression, Expression, Expression]:
        """(memory to keep, trace, command, whether the step is fine); scalar code is evaluated, and its results are selected."""
        inner, opaque, remembered = self.inner, self.inner.opaque, memory
        if "memory" not in self.trusted:
            # Of a graph it is copied as a whole.
            remembered = ca.if_else(usable, memory, ca.DM(inner.memory.start()), opaque)
        memory_next, trace, command = inner.function.call([remembered, *sample], opaque, False)
        skipped = memory if opaque else self._waited(memory, sample, passes)
        after, fine = outcome(memory_next, skipped, command, trace, inner.trace, fits, opaque=opaque)
        if opaque and self.gap is not None and inner.waits is not None:
            after = self._waiting()(ca.logic_and(fits, fine), after, passes, memory, *sample)
        return after, trace, command, fine

    def _waiting(self) -> ca.Function:
        """Function (whether the step was kept, its memory, whether time passes, memory, sample...) -> memory of a graph."""
        step = self.inner.function
        symbols = [kind(opaque=True).sym(step.name_in(k), step.size1_in(k)) for k in range(step.n_in())]
        new, passes = (kind(opaque=True).sym(n, k) for n, k in (("new", symbols[0].numel()), ("passes", 1)))
        arguments = [new, passes, *symbols]
        takes = ca.Function("fpirhc_gate_takes", arguments, [new])
        waits = ca.Function("fpirhc_gate_waits", arguments, [self._waited(symbols[0], symbols[1:], passes)])
        return ca.Function.if_else("fpirhc_gate_kept", takes, waits)

    def _waited(self, memory: Expression, sample: Sequence[Expression], passes: Expression) -> Expression:
        """The controller's memory after a cycle without a sample: as it was, but for what is a memory of the passing time."""
        waits = self.inner.waits
        if self.gap is None or waits is None:
            return memory
        known = {**self.inner.memory.split(memory), **dict(zip(self.inner.reads.names, sample, strict=True))}
        following: dict[str, Expression] = {}
        call(waits, known, following)
        return ca.if_else(passes, self.inner.memory.join(following), memory)
