"""The gate in front of a controller: a bad sample is a skipped cycle.

    sample fits, and the step is finite:  the controller's step, unchanged
    otherwise:                            the last command again, and every memory as it was

A sample fits when time, state and response - or the raw measurements that they are estimated from - are finite and inside their
plausible range. The results of a skipped cycle are dropped. What is remembered is selected, never blended: a product with NaN would
be NaN. A graph of calls is only given samples that fit. In a skipped cycle it is given the last good one again, so that no solver
inside meets a number that is not finite. Scalar code has no solver inside, and needs no sample in store.

An implausible sample is doubted, not refused for ever: after 20 of them in a row the plant is where it should not be, and the
controller is given what is measured, up to 100 times the range. What is not finite is never believed.

Before the first good sample nothing has begun: the command is the one before the run, and the memory is that of the start. A memory
that is not finite is forgotten, and the controller begins anew. So is one with which no step is finite (`step_outcome`).

A memory of the passing time does not stay as it was: queues, filters and observers go on, and are moved over the gap by the next
sample (`gap`).

The gate is built once, around the composed step. Loop, stepper, virtual machine and C have it alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.controllers.base import clip
from fpirhc.controllers.gap import Gap
from fpirhc.controllers.step_outcome import FAILED, counted, is_trial, outcome
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Composite, Derived, Values, call
from fpirhc.symbolic.expression import FINITE, Signals, expression, kind
from fpirhc.symbolic.finite import every_finite, finite
from fpirhc.symbolic.gap import GAPS
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.task.limits import Interval
from fpirhc.task.problem import Problem

HELD = "held_command"  # in the memory: the command that a skipped cycle repeats
DOUBTED = "doubted"  # in the memory: samples in a row that were finite but not plausible
TAKEN = "taken"  # time stamp of a sample
_SAMPLE = ("time", "state", "output", "realised", "measured", "arrived", TAKEN)
_DOUBTED = 20  # samples in a row after which the plant, and not the sensor, is where it should not be
_WIDER = 100.0  # factor of the range inside which such samples are believed
INNER = "controller_memory"  # in the memory: that of a graph as one signal


@dataclass(frozen=True, eq=False)
class Gate:
    """The gate around a controller's step.

    Args:
        problem: that the step is composed for.
        inner: the step of a controller, with the output 'command'.
        trusted: what is always good and not checked, such as the 'time' of a simulated clock, or the 'memory' that a loop keeps.
        plausible: intervals (lower, upper) by column of the sample, "state.q1" or "realised.q1"; every finite number fits where
            there is none.
        max_age: s; where given, the step also reads 'taken', the time stamp of the sample, which must be later than the last one's,
            not later than the time, and not older than this. None: time stamps are not looked at.
        gap: counts missing cycles; None: no sample can be lost.
    """

    problem: Problem
    inner: Composite
    trusted: Sequence[str] = ()
    plausible: Mapping[str, Interval] = field(default_factory=dict)
    max_age: float | None = None
    gap: Gap | None = None

    @cached_property
    def reads(self) -> Layout:
        """What the step reads: as the controller, and the time stamp of the sample where its age counts."""
        own = Layout(tuple([s for s in self.inner.reads.signals if s not in GAPS]))
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
        """The last command, what is kept of the last good sample, the count of doubted ones, and the controller's memory."""
        plant = self.problem.plant
        starts = {plant.output.name: tuple(map(float, self.problem.start_output)), TAKEN: (-FINITE,)}
        starts[plant.state.name] = tuple(map(float, self.problem.start_state))
        first = self.problem.inputs_before
        held = Signal(HELD, plant.input.elements, plant.input.units, tuple(map(float, first)))
        good = [replace(s, name=f"good_{s.name}", start=starts.get(s.name, s.start)) for s in self.stored.signals]
        doubted = [scalar(DOUBTED)] if self.plausible else []
        failed = [] if "memory" in self.trusted else [scalar(FAILED)]
        counts = self.gap.memory if self.gap is not None else ()
        return Layout((held, *good, *doubted, *failed, *counts)) + self.controller_memory

    @cached_property
    def controller_memory(self) -> Layout:
        """The controller's memory; of a graph as one signal, because a graph copies every signal of a long memory one by one."""
        memory = self.inner.memory
        if not self.inner.opaque:
            return memory
        return Layout((Signal(INNER, memory.columns, memory.units, tuple(map(float, memory.start()))),))

    def named(self, memory: Layout) -> Layout:
        """Return a layout with the controller's memory under the names of its signals, where it is one signal there."""
        whole = {INNER: self.inner.memory.signals}
        return Layout(tuple(s for signal in memory.signals for s in whole.get(signal.name, (signal,))))

    def block(self) -> Block:
        """Return the step behind the gate as one block: (sample, parameters) -> the controller's trace."""
        choose = self._switched if self.inner.opaque else self._selected
        trace = self.inner.trace

        entry = self._entry()

        def step(s: Signals) -> dict[str, Expression]:
            now = [getattr(s, n) for n in self.sample.names]
            good = [getattr(s, f"good_{n}") for n in self.stored.names]
            before = getattr(s, DOUBTED) if self.plausible else expression(0.0)
            fits, held, good_next, doubted = entry(ca.vertcat(*now), getattr(s, HELD), ca.vertcat(*good), before)
            last_good = self.stored.split(good_next)
            seen = last_good if self.inner.opaque else {}
            gap, counts = self.gap, {} if self.gap is None else self.gap.counts(s, trusted="memory" in self.trusted)
            told = gap.seen(counts) if gap is not None else {}
            seen = {**seen, **told}
            sample = [seen[r] if r in seen else getattr(s, r) for r in self.inner.reads.names]
            memory = self.controller_memory.join({m: getattr(s, m) for m in self.controller_memory.names})
            usable, failed = expression(1.0), None
            if "memory" not in self.trusted:
                failed = getattr(s, FAILED)
                usable = ca.logic_and(finite(memory, opaque=self.inner.opaque), ca.logic_not(is_trial(failed)))
            passes = gap.passes(counts, s.time) if gap is not None else None
            memory_next, shown, command, fine = choose(fits, usable, memory, sample, held, passes)
            values = trace.split(shown)
            if gap is not None and "status" in trace:
                values["status"] = gap.status(values["status"], told)
            if "status" in trace:
                status = ca.if_else(usable, values["status"], int(Status.RESTARTED))
                status = ca.if_else(fine, status, int(Status.NON_FINITE))
                values["status"] = ca.if_else(fits, status, int(Status.BAD_SAMPLE))
            remembered = {**self.controller_memory.split(memory_next), HELD: command}
            remembered |= {FAILED: counted(failed, fits, fine)} if failed is not None else {}
            remembered |= {f"good_{n}": ca.if_else(fine, v, getattr(s, f"good_{n}")) for n, v in last_good.items()}
            remembered |= {DOUBTED: doubted} if self.plausible else {}
            if gap is not None and passes is not None:
                remembered |= gap.remembered(ca.logic_and(fits, fine), passes, counts, told)
            return {**values, "command": command, **{f"{m}_next": v for m, v in remembered.items()}}

        derived = self._derived if self.inner.derived_if_any else None
        opaque, inside = self.inner.opaque, self.inner
        return Block("gate", self.reads, trace, step, self.memory, opaque=opaque, derived=derived, inside=inside)

    def _derived(self, values: Values) -> Derived:
        """What follows from live settings, with the controller's memory as this block has it."""
        inner = self.inner.derived(values)
        if not self.inner.opaque:
            return inner
        return replace(inner, memory=lambda: {INNER: self.inner.memory.pack(inner.memory())})

    def _entry(self) -> ca.Function:
        """Function (sample, held, stored, doubted) -> (whether the sample fits, held, to store, doubted).

        It is scalar code: a graph would pass over these few numbers one operation after the other.
        """
        inputs, stored = self.problem.plant.input.size, self.stored
        sample, good, held = (
            ca.SX.sym("sample", self.sample.size),
            ca.SX.sym("good", stored.size),
            ca.SX.sym("held", inputs),
        )
        doubted = ca.SX.sym("doubted")
        command, last, count = held, good, doubted
        if "memory" not in self.trusted:
            names = (HELD, *(f"good_{n}" for n in stored.names))
            start = ca.DM([*np.concatenate([self.memory[n].start_vector() for n in names]), 0.0])
            column = ca.vertcat(held, good, doubted)
            column = ca.if_else(every_finite(column), column, start)
            command = clip(column[:inputs], *self.problem.limits.input_bounds(self.problem.plant))
            last, count = column[inputs:-1], column[-1]
        possible = self._possible(sample, last)
        inside = self._inside(sample, 1.0)
        believed = ca.logic_and(count > _DOUBTED - 0.5, self._inside(sample, _WIDER))
        fits = ca.logic_and(possible, ca.logic_or(inside, believed))
        strange = ca.logic_and(possible, ca.logic_not(inside))
        count_next = ca.if_else(strange, count + (count < _DOUBTED - 0.5), ca.if_else(possible, 0, count))
        now = ca.vertcat(*(sample[self.sample.slice(n)] for n in stored.names))
        results = [fits, command, ca.if_else(fits, now, last), count_next]
        return ca.Function("fpirhc_gate_entry", [sample, held, good, doubted], [ca.densify(r) for r in results])

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

    def _inside(self, sample: Expression, wider: float) -> Expression:
        """Whether every entry is inside its interval, made that many times wider; NaN is inside none."""
        inside: Expression = ca.SX(1)
        for k, column in enumerate(self.sample.columns):
            lower, upper = self.plausible.get(column, (-np.inf, np.inf))
            middle, half = (upper + lower) / 2, wider * (upper - lower) / 2
            if np.isfinite(middle) and np.isfinite(half):
                inside = ca.logic_and(inside, ca.fabs(sample[k] - middle) <= half)
            else:  # half an interval is made no wider
                inside = ca.logic_and(inside, sample[k] >= lower) if np.isfinite(lower) else inside
                inside = ca.logic_and(inside, sample[k] <= upper) if np.isfinite(upper) else inside
        return inside

    def _selected(
        self,
        fits: Expression,
        usable: Expression,
        memory: Expression,
        sample: Sequence[Expression],
        held: Expression,
        passes: Expression | None,
    ) -> tuple[Expression, Expression, Expression, Expression]:
        """(memory, trace, command, whether the step is fine) of scalar code: it is evaluated, and its results are selected."""
        remembered = ca.if_else(usable, memory, ca.DM(self.inner.memory.start()))
        memory_next, trace, command = self.inner.function(remembered, *sample)
        skipped = self._waited(memory, sample, passes)
        after, fine = outcome(memory_next, skipped, command, trace, self.inner.trace, fits, opaque=False)
        return after, trace, ca.if_else(ca.logic_and(fits, fine), command, held), fine

    def _switched(
        self,
        fits: Expression,
        usable: Expression,
        memory: Expression,
        sample: Sequence[Expression],
        held: Expression,
        passes: Expression | None,
    ) -> tuple[Expression, Expression, Expression, Expression]:
        """The same of a graph: one of three branches is evaluated, so that a long memory is not selected entry by entry."""
        step = self.inner.function
        names = [(step.name_in(k), step.size1_in(k)) for k in range(step.n_in())]
        symbols = [kind(opaque=True).sym(name, size) for name, size in names]
        last = kind(opaque=True).sym("held", held.numel())
        skip = (symbols[0], step(*symbols)[1], last)
        run = step.call(symbols, True, False)
        restart = step(ca.DM(self.inner.memory.start()), *symbols[1:])
        skipped, running, restarted = (
            ca.Function(f"fpirhc_gate_{name}", [*symbols, last], list(results))
            for name, results in (("skip", skip), ("run", run), ("restart", restart))
        )
        choice = ca.Function.conditional("fpirhc_gate_choice", [skipped, running], restarted)
        memory_next, trace, command = choice(ca.if_else(fits, 2 - usable, 0), memory, *sample, held)
        after, fine = outcome(memory_next, memory, command, trace, self.inner.trace, fits, opaque=True)
        ran = ca.logic_and(fits, fine)
        if passes is not None and self.inner.waits is not None:
            new, started = (kind(opaque=True).sym(n, k) for n, k in (("new", memory.numel()), ("passes", 1)))
            arguments = [new, started, *symbols]
            takes = ca.Function("fpirhc_gate_takes", arguments, [new])
            waits = ca.Function("fpirhc_gate_waits", arguments, [self._waited(symbols[0], symbols[1:], started)])
            after = ca.Function.if_else("fpirhc_gate_kept", takes, waits)(ran, after, passes, memory, *sample)
        return after, trace, ca.if_else(ran, command, held), fine

    def _waited(self, memory: Expression, sample: Sequence[Expression], passes: Expression | None) -> Expression:
        """The controller's memory after a cycle without a sample: as it was, but for what is a memory of the passing time."""
        waits = self.inner.waits
        if passes is None or waits is None:
            return memory
        known = {**self.inner.memory.split(memory), **dict(zip(self.inner.reads.names, sample, strict=True))}
        following: dict[str, Expression] = {}
        call(waits, known, following)
        return ca.if_else(passes, self.inner.memory.join(following), memory)
