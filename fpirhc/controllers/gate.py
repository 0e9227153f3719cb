"""The gate in front of a controller: a bad sample is a skipped cycle. Theory: docs/theory.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import casadi as ca
import numpy as np

from fpirhc.controllers.base import clip
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Composite
from fpirhc.symbolic.driver import every_finite, finite, kept_if_finite
from fpirhc.symbolic.expression import FINITE, Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

AGAIN = math.inf  # time of a cycle that is given once more: no number that fits, and no cycle that is missing
# In the memory: cycles since the last good sample, which whoever calls the step replays (`fpirhc.simulation.replay`); -1 before the
# first one.
MISSING = Signal("missing_cycles", start=(-1.0,))
MOST_MISSING = 1e6
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
    said = trace[layout.slice("status")] != int(Status.NON_FINITE)
    good = ca.logic_and(every_finite(command), said)
    kept, finite = kept_if_finite(memory_next, memory, ca.logic_and(ran, good), opaque=opaque)
    return kept, ca.logic_and(finite, good)


def counted(failed: Expression, fits: Expression, fine: Expression) -> Expression:
    """Return the count of the next cycle: bad samples leave it, and after a trial it begins anew; NaN counts as none."""
    more = ca.if_else(failed < PATIENCE, failed + 1, 0)
    return ca.if_else(fits, ca.if_else(fine, 0, more), ca.if_else(failed <= PATIENCE, failed, 0))


def is_trial(failed: Expression) -> Expression:
    """Return whether this cycle is tried with the memory of the start; a count that cannot be, after a flipped bit, is none."""
    return failed == PATIENCE


def behind_gate(block: Block, status: str) -> Block:
    """Return the block with the number of skipped cycles, in which its memory stays; numbers that are not finite begin anew at 0.

    A cycle was skipped where its sample, its time or its step was not good, by the signal `status`.
    """
    before = Signal(f"{SKIPPED}_before")
    memory = block.memory + Layout((before,))

    def step(s: Signals) -> dict[str, Expression]:
        own = {n: ca.if_else(ca.fabs(getattr(s, n)) <= FINITE, getattr(s, n), 0) for n in memory.names}
        bad = Status.BAD_SAMPLE, Status.NON_FINITE, Status.BAD_TIME
        skips = reduce(ca.logic_or, (getattr(s, status) == int(one) for one in bad))
        values = block.step(Signals({**vars(s), **own}))
        kept = {f"{n}_next": ca.if_else(skips, own[n], values[f"{n}_next"]) for n in block.memory.names}
        count = own[before.name] + skips
        return {**values, **kept, SKIPPED: count, f"{before.name}_next": count}

    return replace(block, writes=block.writes + Layout((scalar(SKIPPED),)), memory=memory, step=step)


SKIPPED = "skipped"  # number of skipped cycles since the start
HELD = "held_command"  # in the memory: the command that a skipped cycle repeats
REPLAYS = Signal("replays")  # in the memory of a loop: whether its sample is that of `replayed_...`
LOST = scalar("lost_sample")  # whether a simulated sample is lost, which on a real plant is one that is not finite
_SAMPLE = ("state", "output", "realised", "measured", "arrived", LOST.name)
INNER = "controller_memory"  # in the memory: that of the controller as one signal


def named_memory(step: Composite) -> tuple[Composite, Layout]:
    """Return the controller's step inside a step with a gate, and the memory of that, the controller's under its signals' names."""
    inner = next(block.inside for block in step.blocks if block.inside is not None)
    whole = {INNER: inner.memory.signals}
    return inner, Layout(tuple(s for signal in step.memory.signals for s in whole.get(signal.name, (signal,))))


@dataclass(frozen=True, eq=False)
class _Judged:
    """What a sample and the gate's memory say."""

    fits: ca.SX  # whether the sample fits
    held: ca.SX  # the last command
    stored: ca.SX  # of the last good sample, which may be this one


def _scalar(name: str, symbols: Sequence[ca.SX], results: Sequence[Expression]) -> ca.Function:
    return ca.Function(f"fpirhc_gate_{name}", [*symbols], ca.cse([ca.densify(r) for r in results]))


@dataclass(frozen=True, eq=False)
class Gate:
    """The gate around a controller's step."""

    problem: Problem  # that the step is composed for
    inner: Composite  # the step of a controller, with the output 'command'
    # intervals (lower, upper) by column of the sample, "state.q1" or "realised.q1"; every finite number fits where there is none
    ranges: Mapping[str, Interval]
    # number of last good samples that are kept for whoever replays missing cycles, which are then counted; 0: nobody does
    samples: int
    simulated: bool = False  # whether clock and memory are those of a simulated loop, which are always good
    loses: bool = False  # whether the step also reads `LOST`

    @cached_property
    def reads(self) -> Layout:
        """What the step reads: as the controller, and whether the sample is lost where it may be."""
        return self.inner.reads + Layout((LOST,)) if self.loses else self.inner.reads

    @cached_property
    def sample(self) -> Layout:
        """The signals of one sample that are checked."""
        names = _SAMPLE if self.simulated else ("time", *_SAMPLE)
        return Layout(tuple([s for s in self.reads.signals if s.name in names]))

    @cached_property
    def stored(self) -> Layout:
        """The signals of the last good sample that are kept: all for a graph or a replay, else none."""
        kept = self.inner.opaque or self.samples
        return Layout(tuple(s for s in self.sample.signals if kept and s.name != LOST.name))

    @property
    def memory(self) -> Layout:
        """What the gate keeps, and the controller's memory."""
        return self.kept + self.replayed + self.controller_memory

    @cached_property
    def kept(self) -> Layout:
        """The last command, what is kept of the last good sample, and the counts of failed steps and gaps."""
        plant = self.problem.plant
        starts = {plant.output.name: tuple(map(float, self.problem.start_output))}
        starts[plant.state.name] = tuple(map(float, self.problem.start_state))
        first = self.problem.inputs_before
        held = Signal(HELD, plant.input.elements, plant.input.units, tuple(map(float, first)))
        good = [replace(s, name=f"good_{s.name}", start=starts.get(s.name, s.start)) for s in self.stored.signals]
        failed = [] if self.simulated else [scalar(FAILED)]
        older = [replace(s, name=f"{s.name}@{k}") for k in range(2, self.samples + 1) for s in good]
        return Layout((held, *good, *failed, *older, *([MISSING] if self.samples else [])))

    @cached_property
    def replayed(self) -> Layout:
        """Whether a cycle is a replay, and its sample; nothing where a caller gives the samples."""
        own = [s for s in self.reads.signals if s.name in ("time", *self.stored.names)]
        given = not (self.samples and self.simulated)
        return Layout(() if given else (REPLAYS, *(Signal(f"replayed_{s.name}", s.elements, s.units) for s in own)))

    @cached_property
    def controller_memory(self) -> Layout:
        """The controller's memory as one signal, because a graph copies every signal of a long memory one by one."""
        memory = self.inner.memory
        return Layout((Signal(INNER, memory.columns, memory.units, tuple(map(float, memory.start()))),))

    def block(self) -> Block:
        """Return the step behind the gate as one block: (sample, parameters) -> the controller's trace."""
        trace, before, after = self.inner.trace, self._before(), self._after()

        def step(s: Signals) -> dict[str, Expression]:
            replayed = {m.name.removeprefix("replayed_"): getattr(s, m.name) for m in self.replayed.signals[1:]}
            given = {n: ca.if_else(s.replays, value, getattr(s, n)) for n, value in replayed.items()}
            s = Signals({**vars(s), **given})
            now, own = ca.vertcat(*(getattr(s, n) for n in self.sample.names)), self.kept.join(vars(s))
            clock = s.time if self.samples else 0
            fits, column = before(now, own, clock)
            told = self.stored.split(column)
            sample = [told[r] if r in told and self.inner.opaque else getattr(s, r) for r in self.inner.reads.names]
            memory, usable = self.controller_memory.join(vars(s)), expression(True)
            if not self.simulated:
                failed = is_trial(getattr(s, FAILED))
                usable = ca.logic_and(finite(memory, opaque=self.inner.opaque), ca.logic_not(failed))
            memory_next, shown, command, fine = self._stepped(fits, usable, memory, sample)
            values = trace.split(shown)
            status, own_next = after(now, own, clock, usable, fine, values["status"], command)
            kept = self.kept.split(own_next)
            remembered = {**self.controller_memory.split(memory_next), **kept}
            remembered |= {m.name: expression(ca.DM.zeros(m.size)) for m in self.replayed.signals}
            return {
                **values,
                "status": status,
                "command": kept[HELD],
                **{f"{m}_next": v for m, v in remembered.items()},
            }

        opaque, inside = self.inner.opaque, self.inner
        return Block("gate", self.reads, trace, step, self.memory, opaque=opaque, inside=inside)

    def _before(self) -> ca.Function:
        """Function (sample, kept, time) -> (whether the sample fits, the last good sample).

        This and `_after` are scalar code: a graph would pass over these few numbers one operation after the other.
        """
        symbols, judged = self._judged
        return _scalar("before", symbols, [judged.fits, judged.stored])

    def _after(self) -> ca.Function:
        """Function (sample, kept, time, usable, fine, status, command) -> (status, kept one cycle later)."""
        symbols, judged = self._judged
        own, command = self.kept.split(symbols[1]), ca.SX.sym("command", judged.held.numel())
        usable, fine, status = (ca.SX.sym(name) for name in ("usable", "fine", "status"))
        fits, ran = judged.fits, ca.logic_and(judged.fits, fine)
        following = {HELD: ca.if_else(ran, command, judged.held)}
        following |= {
            f"good_{n}": ca.if_else(fine, v, own[f"good_{n}"]) for n, v in self.stored.split(judged.stored).items()
        }
        following |= {FAILED: counted(own[FAILED], fits, fine)} if FAILED in own else {}
        for k in range(2, self.samples + 1):
            for n in self.stored.names:  # a memory that is not finite is forgotten
                kept = ca.if_else(ran, own[f"good_{n}" if k == 2 else f"good_{n}@{k - 1}"], own[f"good_{n}@{k}"])
                start = ca.DM(self.kept[f"good_{n}"].start_vector())
                following[f"good_{n}@{k}"] = ca.if_else(every_finite(kept), kept, start)
        if self.samples:
            before, missing = own[MISSING.name], self._missing(own[MISSING.name], symbols[2])
            # a good sample that the step cannot use is not missing
            following[MISSING.name] = ca.if_else(ran, 0, ca.if_else(fits, before, missing))
        ended = ca.if_else(usable, status, int(Status.RESTARTED))
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
        if not self.simulated:
            names = (HELD, *(f"good_{n}" for n in self.stored.names))
            start = ca.DM(np.concatenate([self.kept[n].start_vector() for n in names]))
            column = ca.vertcat(held, good)
            column = ca.if_else(every_finite(column), column, start)
            command = clip(column[:inputs], *self.problem.limits.input_bounds(self.problem.plant))
            last = ca.vertsplit(column, [0, inputs, column.numel()])[1]  # CasADi's empty slice is a row
        fits = ca.logic_and(every_finite(sample), self._inside(sample))
        now = ca.vertcat(ca.SX(0, 1), *(sample[self.sample.slice(n)] for n in self.stored.names))
        stored = ca.if_else(fits, now, last)
        return [sample, own, time], _Judged(fits, command, stored)

    @staticmethod
    def _missing(before: Expression, time: Expression) -> Expression:
        """Cycles since the last good sample, where that of now is bad."""
        before = ca.if_else(ca.fabs(before) <= MOST_MISSING, before, -1)
        passes = ca.logic_and(before >= 0, time != AGAIN)
        return ca.if_else(passes, ca.fmin(before + 1, MOST_MISSING), before)

    def _inside(self, sample: Expression) -> Expression:
        """Whether every entry is inside its interval, and no sample is lost; NaN is inside none."""
        inside: Expression = ca.SX(True)
        for k, column in enumerate(self.sample.columns):
            lower, upper = (-np.inf, 0.0) if column == LOST.name else self.ranges.get(column, (-np.inf, np.inf))
            inside = ca.logic_and(inside, sample[k] >= lower) if np.isfinite(lower) else inside
            inside = ca.logic_and(inside, sample[k] <= upper) if np.isfinite(upper) else inside
        return inside

    def _stepped(
        self, fits: Expression, usable: Expression, memory: Expression, sample: Sequence[Expression]
    ) -> tuple[Expression, Expression, Expression, Expression]:
        """(memory to keep, trace, command, whether the step is fine); scalar code is evaluated, and its results are selected."""
        inner, opaque, remembered = self.inner, self.inner.opaque, memory
        if not self.simulated:
            # Of a graph it is copied as a whole.
            remembered = ca.if_else(usable, memory, ca.DM(inner.memory.start()), opaque)
        memory_next, trace, command = inner.function.call([remembered, *sample], opaque)
        after, fine = outcome(memory_next, memory, command, trace, inner.trace, fits, opaque=opaque)
        return after, trace, command, fine
