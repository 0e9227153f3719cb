"""Cycles without a good sample are run afterwards, by whoever calls the step: a block knows nothing of them.

    a sample is bad, or its cycle was missed   the command stays, and every memory; the gate counts (`fpirhc.controllers.gate`)
    the next good sample, k cycles later       the same step runs k times more, on z_1 ... z_k, and then on this sample

z_i lies on the polynomial of the plant's order through the last good samples and the new one: so a plant moves whose input is
held. The commands of these steps are dropped: the one in force went on acting, so what remembers the last command keeps it.
After more than `bridged` cycles the windows of estimators and observers alone are filled anew, and everything else stays as it
was before the gap. A stepper, a simulated loop and `export/targets/controller.c` do the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from fpirhc.controllers.gate import FAILED, HELD, INNER, MISSING, MOST_MISSING, REPLAYS
from fpirhc.controllers.seeing import seeing_blocks
from fpirhc.simulation.clock import MEMORY as CLOCK
from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.expression import FINITE
from fpirhc.symbolic.layout import Layout, Signal
from fpirhc.task.problem import Problem

BRIDGED, BY_DIFFERENCES = 5, 20  # cycles: the longest gap that is replayed as it was; behind differences of positions
_OBSERVED, _SETTLES = "observed_state", 30  # state of a learner, and the steps in which it follows the samples
_FORGOTTEN = 1e-7  # of a sample from before a long gap


def known_samples(problem: Problem) -> int:
    """Return how many good samples are kept: as many as the plant's order."""
    return max(1, *problem.plant.chains.values())


def usually_bridged(problem: Problem) -> int:
    """Return the longest gap that is replayed where nobody states another."""
    plant, estimator = problem.plant, problem.sensing.estimator
    shortest = all(estimator.fills(plant.chains[name]) == plant.chains[name] for name in plant.controlled_names)
    return BY_DIFFERENCES if problem.sensing.estimates and shortest else BRIDGED


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
    late = problem.dead_time
    queued = max(late.inputs.values(), default=0.0) / period
    weights = [np.cumsum(estimator.weights(plant.chains[name], period)) for name in plant.controlled_names]
    longest = max(int(np.argmax(w >= w[-1] - _FORGOTTEN)) + 1 for w in weights)
    return math.ceil(problem.warm_up_cycles + queued) + longest


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
        inner = next(block.inside for block in step.blocks if block.inside is not None)
        memory = Layout(
            tuple(s for one in step.memory.signals for s in (inner.memory.signals if one.name == INNER else (one,)))
        )
        windows = {s.name for block in seeing_blocks(problem)[0] for s in block.memory.signals}
        acted = {delay.now.name for delay in inner.delays if delay.source == "command"}
        own = set(inner.memory.names)
        observed = {_OBSERVED} & own  # by a learner, which would take what happened in the gap for a disturbance
        gate = {name for name in memory.names if name in (MISSING.name, FAILED) or name.startswith("good_")}
        every = np.arange(memory.size)

        def places(signals: list[Signal]) -> np.ndarray:
            return np.concatenate([every[memory.slice(s.name)] for s in signals])

        moves = gate | (own - acted) | {CLOCK.name}
        kept = [s for s in memory.signals if s.name not in moves or s.name == HELD]
        stays = [s for s in memory.signals if s in kept or s.name in own - windows - observed]
        good: dict[str, list[np.ndarray]] = {}
        for name in memory.names:
            if name.startswith("good_") and name.partition("@")[0] != "good_time":
                good.setdefault(name.removeprefix("good_").partition("@")[0], []).append(every[memory.slice(name)])
        return cls(
            memory.slice(MISSING.name).start,
            every[memory.slice(CLOCK.name)][:1] if CLOCK.name in memory else every[:0],
            step.trace.slice("status").start if "status" in step.trace else -1,
            places(kept),
            places(stays),
            good,
            float(problem.period),
            usually_bridged(problem) if bridged is None else bridged,
            max(_forgets(problem) if windows else 0, _SETTLES if observed else 0),
        )

    @property
    def evaluations(self) -> int:
        """Most evaluations of one step: a trial, the missing cycles, and the one of now."""
        return max(self.bridged, self.fills) + 2

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
