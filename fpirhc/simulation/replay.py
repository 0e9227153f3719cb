"""The time of steps, which cycles are missing, and how these are run afterwards by who calls the step: blocks know nothing of it.

    a sample is bad, or its cycle was missed   the command stays, and every memory; the gate counts (`fpirhc.controllers.gate`)
    the next good sample, k cycles later       the same step runs k times more, on z_1 ... z_k, and then on this sample

z_i lies on the polynomial of the plant's order through the last good samples and the new one: so a plant moves whose input is
held. The commands of these steps are dropped: the one in force went on acting, so what remembers the last command keeps it.
After more than `bridged` cycles the windows of estimators and observers alone are filled anew, and everything else stays as it
was before the gap. A stepper, a simulated loop and `export/templates/controller.c` do the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Self

import casadi as ca
import numpy as np

from fpirhc.controllers.gate import AGAIN, FAILED, HELD, LOST, MISSING, MOST_MISSING, REPLAYS, Gate, named_memory
from fpirhc.controllers.seeing import seeing_blocks, sensor_ranges
from fpirhc.simulation.moved import ANSWER, Mover, moving
from fpirhc.simulation.ranges import Range
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Composite
from fpirhc.symbolic.driver import every_finite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.expression import FINITE, Signals, nan_where
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.dead_time import Queue
from fpirhc.task.problem import Problem

# In the memory: the last time that was believed, or is expected; the last one that was given; and times in a row that are a period
# apart but do not follow the believed one.
CLOCK_MEMORY = Signal("clock", ("before", "heard", "regular"), start=(-FINITE, -FINITE, 0.0))
CLOCK = "_clock"  # signal of the believed time; NaN where it is none, and AGAIN where it repeats
LONGEST = 1e5  # periods between two steps
_RESOLVED = 2.0**42  # periods from zero within which a period is resolved to a thousandth
_PATIENCE = 20
BRIDGED, BY_DIFFERENCES = 5, 20  # cycles: the longest gap that is replayed as it was; behind differences of positions
_OBSERVED, _SETTLES = "observed_state", 30  # state of a learner, and the steps in which it follows the samples
_LOST_QUEUE, _SILENT = "lost_samples_queue", scalar("no_answer")
_CHUNK = 500  # cycles of a compiled call: long enough to hide Python, short enough for progress and Ctrl-C
_SHORT = 25  # of the virtual machine, for which a longer chain takes longer than it saves
_FORGOTTEN = 1e-7  # of a sample from before a long gap


def clock_block(problem: Problem) -> Block:
    """Return the block (time) -> the time where it may be believed, else NaN; and the memory of the clock."""
    period = float(problem.period)

    def step(s: Signals) -> dict[str, Expression]:
        time, (before, heard, regular) = s.time, ca.vertsplit(getattr(s, CLOCK_MEMORY.name))
        resolved = ca.fabs(time) <= _RESOLVED * period
        first = ca.logic_not(before > -FINITE / 2)  # also of a memory that is not finite
        passed = time - before
        follows = ca.logic_and(passed >= period / 2, passed <= LONGEST * period)
        apart = ca.fabs(time - heard - period) <= period / 2
        count = ca.if_else(apart, regular + 1, 0)
        believed = ca.logic_and(resolved, ca.logic_or(ca.logic_or(first, follows), count > _PATIENCE - 0.5))
        repeats = ca.fabs(passed) < period / 2
        again = ca.logic_and(repeats, ca.logic_not(believed))
        expected = ca.if_else(ca.logic_or(first, repeats), before, before + period)
        return {
            CLOCK: ca.if_else(again, AGAIN, time) + nan_where(ca.logic_not(ca.logic_or(believed, again))),
            f"{CLOCK_MEMORY.name}_next": ca.vertcat(
                ca.if_else(believed, time, ca.if_else(expected > -FINITE, expected, -FINITE)),
                ca.if_else(ca.fabs(time) <= FINITE, time, -FINITE),
                ca.if_else(believed, 0, ca.if_else(count < _PATIENCE, count, 0)),
            ),
        }

    return Block("clock", Layout((problem.plant.time,)), Layout((Signal(CLOCK),)), step, Layout((CLOCK_MEMORY,)))


def clock_status_block(problem: Problem, before: str, after: str) -> Block:
    """Return the block (time, believed time, status) -> status: BAD_TIME for a cycle skipped for a finite time."""
    reads = Layout((problem.plant.time, Signal(CLOCK), scalar(before)))

    def step(s: Signals) -> dict[str, Expression]:
        refused = ca.logic_and(ca.fabs(s.time) <= FINITE, ca.logic_not(ca.fabs(getattr(s, CLOCK)) <= FINITE))
        return {after: ca.if_else(refused, int(Status.BAD_TIME), getattr(s, before))}

    return Block("clock_status", reads, Layout((scalar(after),)), step)


def missed_cycles(time: float, before: float, period: float) -> int:
    """Return how many cycles lie between two steps; 0 where the later one is the next cycle, or cannot follow the other.

    The sample of a missed cycle is missing. The command of the last step went on acting in it, as in every cycle that is skipped.

    Args:
        before: time of the step before it, as the clock remembers it; -FINITE: there was none.
    """
    cycles = (time - before) / period
    return round(cycles) - 1 if before > -FINITE / 2 and 1.5 <= cycles <= LONGEST else 0


def known_samples(problem: Problem) -> int:
    """Return how many good samples are kept: as many as the plant's order."""
    return max(1, *problem.plant.chains.values())


def gated_blocks(mover: Mover, inner: Composite) -> list[Block]:
    """Return the block of a controller behind the gate of a simulated loop, after that of lost samples where any can be lost."""
    problem, lost, ranges = mover.problem, _lost_blocks(mover), sensor_ranges(mover.problem)
    samples = known_samples(problem) if lost or ranges else 0
    gate = Gate(problem, inner, simulated=True, ranges=ranges, loses=bool(lost), samples=samples)
    return [*lost, gate.block()]


def needs_driver(problem: Problem) -> str:
    """Return what to leave out so that the cycles of a loop follow each other by themselves; empty where they do."""
    return "the plant outside, and dropout and range" * bool(_lost_blocks(moving(problem)) or sensor_ranges(problem))


def cycles_per_call(problem: Problem, *, compiled: bool) -> int:
    """Return how many cycles one call of the loop runs."""
    return 1 if needs_driver(problem) else _CHUNK if compiled else _SHORT


def answer_blocks(mover: Mover) -> list[Block]:
    """Block (answer of a plant outside) -> its last finite one, and for how many cycles there has been none; [] where none is."""
    if not mover.reads:
        return []
    [raw] = mover.reads
    last, count = like(raw, f"{ANSWER}_last"), Signal(f"{_SILENT.name}_before")

    def step(s: Signals) -> dict[str, Expression]:
        now = getattr(s, raw.name)
        there = every_finite(now)
        shown = ca.if_else(there, now, getattr(s, last.name))
        silent = ca.if_else(there, 0, getattr(s, count.name) + 1)
        return {ANSWER: shown, _SILENT.name: silent, f"{last.name}_next": shown, f"{count.name}_next": silent}

    return [Block("answer", Layout((raw,)), Layout((like(raw, ANSWER), _SILENT)), step, Layout((last, count)))]


def _lost_blocks(mover: Mover) -> list[Block]:
    """Blocks that say whether the sample that a controller is given is lost, `LOST`; none where none can be."""
    problem, silent = mover.problem, [_SILENT] * bool(mover.reads)
    drawn = problem.sensing.drawn
    if not silent and problem.sensing.lost(ca.SX.zeros(sum(one.size for one in drawn))) is None:
        return []
    late = problem.dead_time.measurement_wait(problem.period) or Queue(0.0)

    def step(s: Signals) -> dict[str, Expression]:
        lost = problem.sensing.lost(ca.vertcat(*(getattr(s, one.name) for one in drawn)))
        now = ca.mmax(ca.vertcat(*([] if lost is None else [lost]), *(getattr(s, one.name) > 0 for one in silent)))
        arrived, remembered = late.arrived(s, _LOST_QUEUE, now)
        return {LOST.name: arrived, **remembered}

    memory = Layout(late.memory(_LOST_QUEUE, ("sample",), (0.0,)))
    return [Block("lose", Layout((*drawn, *silent)), Layout((LOST,)), step, memory)]


def raw_measurements(run: Run) -> np.ndarray:
    """Return what the controller of a run was given in every cycle, shape (cycles, number of measurements); NaN where it was lost.

    It is what the sensors show, as it arrives; state and response where both are measured. `Stepper.step_measured` takes its rows.
    Of a plant with outputs the state stands before raw measurements of these, unless it is believed.
    """
    shown = next((name for name in ("arrived", "measured") if name in run.layout), None)
    if shown is None:
        names = [name for name in ("state", "output", "realised") if name in run.layout]
    else:
        # A state that is logged before the measurements is not made from them.
        state_measured = "output" in run.layout and run.layout.names.index("state") < run.layout.names.index(shown)
        names = ["state", shown] if state_measured else [shown]
    return where_given(run, np.hstack([run[name].reshape(run.cycles, -1) for name in names]))


def where_given(run: Run, rows: np.ndarray) -> np.ndarray:
    """Return rows of what a controller saw, shape (cycles, n), with NaN where its sample was lost."""
    return np.where(run[LOST.name] > 0, np.nan, rows) if LOST.name in run.layout else rows


def shares(first: int, missing: int, known: int) -> np.ndarray:
    """Return the weights of the new sample and of the good ones, newest first: a row for every missing one from `first` on."""
    places = [float(missing + 1), *(float(-j) for j in range(known))]
    result = np.ones((missing + 1 - first, known + 1))
    for i in range(len(result)):
        for j, own in enumerate(places):
            for other in (*places[1:], places[0]):
                if other != own:
                    result[i, j] *= (first + i - other) / (own - other)
    return result


def _forgets(problem: Problem) -> int:
    """Number of samples after which an estimate no longer shows what was before them."""
    plant, estimator, period = problem.plant, problem.sensing.estimator, problem.period
    queued = Queue(max(problem.dead_time.inputs.values(), default=0.0) / period).length - 1
    weights = [np.cumsum(estimator.weights(plant.chains[name], period)) for name in plant.controlled_names]
    longest = max(int(np.argmax(w >= w[-1] - _FORGOTTEN)) + 1 for w in weights)
    return problem.warm_up_cycles + queued + longest


@dataclass(frozen=True, eq=False)
class Bound:
    """The arrays of one step: memory before and after it, trace, its sample by name, the new sample, and where its time stands."""

    memory: np.ndarray
    after: np.ndarray
    trace: np.ndarray
    sample: Mapping[str, np.ndarray]
    now: Mapping[str, np.ndarray]
    time: np.ndarray
    time_now: np.ndarray
    replays: np.ndarray = field(default_factory=lambda: np.zeros(1))  # set while a cycle is a replay


@dataclass(frozen=True, eq=False)
class Replay:
    """Where a step's memory has what a replay needs."""

    missing: int  # place of the count of missing cycles
    clock: np.ndarray  # place of the last time; none in a loop
    status: int  # place of the status, in the trace; -1: there is none
    kept: np.ndarray  # places of what stays as it was: the command in force, what acted, counts, a simulated plant
    stays: np.ndarray  # places of what stays after a long gap: all but the windows of estimators and observers
    good: dict[str, list[np.ndarray]]  # places of the last good samples, by name of their signal, the newest first
    period: float
    bridged: int
    fills: int  # steps that fill every window

    @classmethod
    def of(cls, problem: Problem, step: Composite, bridged: int | None = None) -> Self:
        """Return the replay of a step that has the gate inside; `bridged`: None: as is usual for the problem."""
        inner, memory = named_memory(step)
        plant, estimator = problem.plant, problem.sensing.estimator
        shortest = all(max(estimator.fills(plant.chains[n]), 1) == plant.chains[n] for n in plant.controlled_names)
        usual = BY_DIFFERENCES if problem.sensing.estimates and shortest else BRIDGED
        windows = {s.name for block in seeing_blocks(problem)[0] for s in block.memory.signals}
        acted = {delay.now.name for delay in inner.delays if delay.source == "command"}
        own = set(inner.memory.names)
        observed = {_OBSERVED} & own  # by a learner, which would take what happened in the gap for a disturbance
        gate = {name for name in memory.names if name in (MISSING.name, FAILED) or name.startswith("good_")}
        every = np.arange(memory.size)

        def places(signals: list[Signal]) -> np.ndarray:
            return np.concatenate([every[memory.slice(s.name)] for s in signals])

        moves = gate | (own - acted) | {CLOCK_MEMORY.name}
        kept = [s for s in memory.signals if s.name not in moves or s.name == HELD]
        stays = [s for s in memory.signals if s in kept or s.name in own - windows - observed]
        good: dict[str, list[np.ndarray]] = {}
        for name in memory.names:
            if name.startswith("good_") and name.partition("@")[0] != "good_time":
                good.setdefault(name.removeprefix("good_").partition("@")[0], []).append(every[memory.slice(name)])
        return cls(
            memory.slice(MISSING.name).start,
            every[memory.slice(CLOCK_MEMORY.name)][:1] if CLOCK_MEMORY.name in memory else every[:0],
            step.trace.slice("status").start if "status" in step.trace else -1,
            places(kept),
            places(stays),
            good,
            float(problem.period),
            usual if bridged is None else bridged,
            max(_forgets(problem) if windows else 0, _SETTLES if observed else 0),
        )

    def after(self, a: Bound, evaluate: Callable[[], str]) -> str:
        """Run what is missing before a step that has been evaluated as a trial, and the step again, where it had a good sample.

        `evaluate`: the step; returns why it failed, empty where it did not, and so does this: the memory is then as it was.
        """
        missing = a.memory[self.missing]
        accepted = 0.5 < missing <= MOST_MISSING and not a.after[self.missing]
        return self._run(a, evaluate, round(missing)) if accepted else ""

    def _run(self, a: Bound, evaluate: Callable[[], str], missing: int) -> str:
        memory, time, before = a.memory, float(a.time_now[0]), a.memory.copy()
        now = {n: a.now[n].copy() for n in self.good}
        short = missing <= self.bridged
        known, kept = len(next(iter(self.good.values()))), self.kept if short else self.stays
        first = 1 if short else max(missing - self.fills, 0) + 1
        memory[self.clock], why = -FINITE, ""  # as at the start: any time may follow
        for i, weights in enumerate(shares(first, missing, known), first):
            a.replays[:] = 1.0
            for n, places in self.good.items():
                value = weights[0] * now[n]
                for weight, place in zip(weights[1:], places[:known], strict=True):
                    value = value + weight * before[place]
                a.sample[n][:] = value
            a.time[0] = time - (missing + 1 - i) * self.period
            why = why or evaluate()
            memory[:] = a.after
            memory[kept] = before[kept]
        a.replays[:], a.time[0] = 0.0, time
        for n, value in now.items():
            a.sample[n][:] = value
        why = why or evaluate()
        if why:
            memory[:] = before
        elif self.status >= 0 and a.trace[self.status] == int(Status.OK):
            a.trace[self.status] = int(Status.BRIDGED if short else Status.SETTLING)
        return why


def replaying(problem: Problem, loop: Composite, evaluator: Evaluator) -> Callable[[np.ndarray, np.ndarray], str]:
    """Return the function (memory, trace) that is called after every cycle of a loop, and says why it failed, as `Replay.after`."""
    if REPLAYS.name not in loop.memory:
        return lambda *_: ""
    replay, place = Replay.of(problem, loop), loop.memory.slice

    def again(memory: np.ndarray, trace: np.ndarray) -> str:
        if memory[replay.missing] <= 0:
            return ""
        sample = {n: memory[place(f"replayed_{n}")] for n in replay.good}
        now = {n: trace[loop.trace.slice(n)] for n in (*replay.good, "time")}
        time, flag = memory[place("replayed_time")], memory[place(REPLAYS.name)]
        bound = Bound(memory, evaluator.results[0], trace, sample, now, time, now["time"], flag)
        return replay.after(bound, evaluator.failure)

    return again


def silence(problem: Problem, loop: Composite) -> list[Range]:
    """Return what ends the run of a plant outside: more cycles in a row without an answer than a replay bridges."""
    if _SILENT.name not in loop.trace:
        return []
    words = "the plant outside gave no answer in", "cycles in a row"
    return [Range(loop.trace.slice(_SILENT.name).start, 0, Replay.of(problem, loop).bridged, words)]
