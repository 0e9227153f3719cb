"""A closed loop that is asked: it runs from any memory, and is linearised at points along its run by `Linearisation`.

The step is the one that simulates, with disturbances and noise at zero and sensors without their quantum. Both parameter sets are
part of its memory, so other plants and models need no other build.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import any_gain
from fpirhc.controllers.contract import resolved
from fpirhc.errors import NoAnswer, NotSupported
from fpirhc.optimisers.base import FEASIBLE
from fpirhc.simulation.linearise.linear_map import GAIN, places_of
from fpirhc.simulation.linearise.slopes import CALL, STATE_BEFORE, Step
from fpirhc.simulation.loop import close_loop, start_memory
from fpirhc.simulation.simulate import pieces
from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.layout import Kind
from fpirhc.task.disturbance import Step as Jump
from fpirhc.task.problem import Problem

_ROOM = 0.01  # share of the range between an input's limits, nearer than which a command stands at one
AWAY = 1e100  # of an entry, from which a run has run away: squares of what is larger overflow
_LOOK = 50  # cycles after which a run is looked at, whether it is at rest
_STILL = 1e-7  # change of a command from period to period, as a share of the largest


@dataclass(frozen=True, eq=False)
class Passage:
    """A part of a loop's run."""

    memories: np.ndarray  # before every cycle and after the last, shape (cycles + 1, n)
    trace: np.ndarray  # of every cycle, shape (cycles, columns)


class AskedLoop:
    """A closed loop whose step is run; it works in one thread only."""

    def __init__(self, problem: Problem, controller: Controller) -> None:
        """Compose the loop."""
        problem.require_equations("the step of a loop with an ExternalPlant cannot be evaluated twice at one point")
        self.problem = _CALM.of((problem,), (), lambda: _calm(problem))
        self.controller = resolved(problem, controller)
        with any_gain(), compiled_plans():  # one that a run refuses has poles too
            self.loop: Composite = close_loop(self.problem, self.controller)
        self.step = Step(self.loop, self.loop.reads.names[0])  # the disturbances of all inputs
        names = self.loop.trace.names
        self.command = self.loop.trace.slice("command")
        self.arriving = self.loop.trace.slice("arriving" if "arriving" in names else "command")
        self._statuses = [k for k, c in enumerate(self.loop.trace.columns) if c == "status"]
        self._violations = [k for k, c in enumerate(self.loop.trace.columns) if c.endswith("solve.feasibility")]
        self.errors = self.loop.trace.slice("true_error" if "true_error" in names else "error")
        self.state = self.loop.memory.slice(STATE_BEFORE)
        self._request = [k for k, c in enumerate(self.loop.memory.columns) if "_deformed_last." in c]
        self._phases = [k for k, kind in enumerate(self.loop.memory.kinds) if kind == Kind.PHASE]
        self.gain_places = places_of(GAIN, self.loop)

    @property
    def quick(self) -> bool:
        """Whether a step has neither a plan nor a solver in it."""
        return self.step.scalar

    @property
    def gained(self) -> bool:
        """Whether the gain of a `LinearMap` is in the memory."""
        return bool(self.gain_places)

    @cached_property
    def repeats(self) -> int:
        """Cycles after which the loop repeats itself: those between two plans."""
        return len(self.period(self.start()))

    def start(
        self,
        *,
        time: float = 0.0,
        state: Mapping[str, float] | None = None,
        before: Mapping[str, float] | None = None,
        exact: np.ndarray | None = None,
        gain: float | None = None,
    ) -> np.ndarray:
        """Return the memory of a loop that is started.

        Args:
            state: first state of the model; None: that of the problem.
            before: inputs before; None: those of the problem.
            exact: parameters of the plant that moves; None: its own.
            gain: of a `LinearMap`; None: its own.
        """
        memory = start_memory(self.loop, _started(self.problem, state, before), self.controller)
        memory[self.loop.memory.slice("cycle")] = round(time / self.problem.period)
        if exact is not None and exact.size:  # an empty signal has one entry
            memory[self.loop.memory.slice("_exact")] = exact
        return memory if gain is None else self.with_gain(memory, gain)

    def with_gain(self, memory: np.ndarray, gain: float) -> np.ndarray:
        """Return the memory with another gain of a `LinearMap`."""
        if not self.gained:
            raise NotSupported("the gain is no part of the loop's memory")
        changed = memory.copy()
        changed[self.gain_places] = gain
        return changed

    def run(
        self, memory: np.ndarray, cycles: int, led: np.ndarray | None = None, request: np.ndarray | None = None
    ) -> Passage:
        """Return the run from a memory; it ends before the first cycle that runs away, or where it is led and has come to rest.

        Args:
            led: states (cycles, nx) at which the plant is put after each cycle, so that it stays on the reference while what the
                controller remembers finds its place there; those that are NaN move by themselves. None: all do.
            request: that is put in place of the last deformed response once everything else has found its place, so that an
                iteration that does not converge is near its fixed point too; None: none is.
        """
        memories, traces = np.empty((cycles + 1, memory.size)), np.empty((cycles, self.loop.trace.size))
        memories[0], end, run = memory, cycles, self.step.led
        (begin, put), (after, trace, states) = run.arguments, (one.reshape(CALL, -1) for one in run.results)
        put = put.reshape(CALL, -1)
        put[:] = np.nan
        asked = self.warm + 1 if request is not None and len(self._request) == request.size else -1
        looks = range(_LOOK, cycles + 1, _LOOK) if led is not None else ()
        for at, until in pieces(cycles, CALL, [asked, *looks]):
            begin[:] = memories[at]
            if led is not None:
                put[: until - at] = led[at:until]
            run.evaluate()
            sizes = np.maximum(np.abs(after).max(axis=1), np.abs(states).max(axis=1, initial=0.0))[: until - at]
            memories[at + 1 : until + 1], traces[at:until] = after[: until - at], trace[: until - at]
            if not (sizes < AWAY).all():
                end = at + int(np.argmin(sizes < AWAY))
                break
            if until == asked:
                memories[until, self._request] = request
            at_rest = self._at_rest(traces[:until]) if until in looks else None
            if at_rest is not None:
                end = at_rest
                break
        sent = np.isfinite(traces[:end, self.arriving]).all(axis=1)
        end = end if sent.all() else int(np.argmin(sent))
        return Passage(memories[: end + 1], traces[:end])

    def _at_rest(self, traces: np.ndarray) -> int | None:
        """The number of cycles after which commands have been still for longer than they may take; None: they have not."""
        commands, n, first = traces[:, self.command], self.repeats, self.warm + 1
        now, before = commands[first:], commands[first - n : len(commands) - n]
        with np.errstate(invalid="ignore"):
            still = (np.abs(now - before) <= _STILL * np.abs(now).max(axis=1, keepdims=True)).all(axis=1)
        counts = np.convolve(still, np.ones(self.longest + 1), "valid") if len(still) > self.longest else still[:0]
        rests = np.flatnonzero(counts > self.longest)
        return first + int(rests[0]) + self.longest + 1 if rests.size else None

    def quietest(self, passage: Passage) -> np.ndarray:
        """Return the memory in the quietest part of a run: where commands differ least from those of the period before.

        Plans are in the same phase there as at the beginning of the run. Cycles at a limit are left out as long as there are
        others: there a command has no slope.
        """
        commands, n = passage.trace[:, self.command], self.repeats
        if len(commands) <= n + 1:
            raise NoAnswer("the loop's run does not stay finite in its first cycles")
        inside = self.has_room(commands)
        sizes = np.maximum(np.abs(commands).max(axis=0), 1e-300)
        change = (np.abs(commands[n:] - commands[:-n]) / sizes).max(axis=1)
        quiet = np.logical_and(inside[n:], inside[:-n])
        quiet[: min(self.warm, len(quiet) - 1)] = False
        memories = passage.memories[n : n + len(quiet)]
        phased = (memories[:, self._phases] == passage.memories[0, self._phases]).all(axis=1)
        change = np.where(quiet & phased if (quiet & phased).any() else phased, change, np.inf)
        return np.asarray(passage.memories[n + len(change) - 1 - int(np.argmin(change[::-1]))])

    def inside(self, memory: np.ndarray) -> bool:
        """Return whether no command of the next cycle stands at a limit."""
        return bool(self.has_room(self.step(memory)[1][self.command]))

    def feasible(self, memory: np.ndarray) -> bool:
        """Return whether the next cycle has a plan that keeps its limits of states; a loop without such a plan breaks none."""
        return bool((self.step(memory)[1][self._violations] <= FEASIBLE).all())

    def solves(self, memory: np.ndarray) -> bool:
        """Return whether the next cycle has a plan that is solved, as soft limits may be beyond theirs."""
        return all(Status(int(one)) == Status.OK for one in self.step(memory)[1][self._statuses])

    def skips(self, memory: np.ndarray) -> bool:
        """Return whether the next cycle is skipped, with the last command and every memory as it was."""
        return any(Status(int(one)).skips for one in self.step(memory)[1][self._statuses])

    def has_room(self, commands: np.ndarray) -> np.ndarray:
        """Return which commands (..., nu) have room to all limits, shape (...)."""
        lower, upper = self.problem.limits.input_bounds(self.problem.plant)
        room = _ROOM * np.where(np.isfinite(upper - lower), upper - lower, 0.0)
        return np.asarray(np.all((commands > lower + room) & (commands < upper - room), axis=-1))

    @cached_property
    def longest(self) -> int:
        """Cycles that a command may take through the loop before anything of it is seen."""
        return 2 * self.repeats + 2 * math.ceil(self.problem.response_delay) + 2

    @cached_property
    def warm(self) -> int:
        """Cycles before which no deformation acts, or no command has gone all the way."""
        return self.longest + math.ceil(self.problem.warm_up_cycles)

    def period(self, memory: np.ndarray) -> list[np.ndarray]:
        """Return the memories of as many cycles as pass until the phases of plans are the same again."""
        memories, passed = [memory], {memory[self._phases].tobytes()}
        while True:
            memory_next, _ = self.step(memories[-1])
            if np.array_equal(memory_next[self._phases], memory[self._phases]):
                return memories
            if not np.isfinite(memory_next).all():
                raise NoAnswer("the loop's run does not stay finite from one plan to the next")
            phases = memory_next[self._phases].tobytes()
            if phases in passed:  # a cycle that is skipped for ever
                raise NoAnswer("the loop's run does not come to its next plan")
            memories.append(memory_next)
            passed.add(phases)


def _started(problem: Problem, state: Mapping[str, float] | None, before: Mapping[str, float] | None) -> Problem:
    """The problem with another start, which is not checked again: that takes longer than the linearisation."""
    changes: dict[str, object] = {} if state is None else {"start": state}
    if before is not None:
        changes |= {"input_before": before, "dead_time": replace(problem.dead_time, before={})}
    moved = copy(problem)
    for name in ("start_state", "inputs_before", "real_start", "start_output"):  # which the problem remembers
        vars(moved).pop(name, None)
    for name, value in changes.items():
        object.__setattr__(moved, name, value)
    return moved


_CALM: Latest[Problem] = Latest(4)


def _calm(problem: Problem) -> Problem:
    """The problem without disturbances and lost samples, and with an entry for signals at its inputs."""
    sensors = {n: replace(s, quantum=None, dropout=0.0) for n, s in problem.sensing.sensors.items()}
    keys = problem.disturbable[: len(problem.plant.inputs)]
    still = {key: Jump(at=0.0, size=0.0) for key in keys}
    return replace(problem, disturbances=still, sensing=replace(problem.sensing, sensors=sensors))
