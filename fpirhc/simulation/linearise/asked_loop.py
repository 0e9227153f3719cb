"""A closed loop that is asked: it runs from a point of its task, and is linearised at points along this run.

The step is the one that simulates, with disturbances and noise at zero and sensors without their quantum. Both parameter sets are
part of its memory, so other plants and models need no other build. A map is the one that it is near its fixed point,
r+ = r - a (f - d), with the gain a in its memory: the loop for every gain is one loop with other memories, affine in a.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import any_gain
from fpirhc.controllers.contract import resolved, with_optimiser
from fpirhc.deformation.base import Deformation, Iteration, with_inner
from fpirhc.errors import FpirhcError, NoAnswer, NotSupported
from fpirhc.optimisers.base import FEASIBLE
from fpirhc.simulation.linearise.late_loop import Late, LateLoop
from fpirhc.simulation.linearise.linear_loop import LinearCycle, LinearLoop
from fpirhc.simulation.linearise.slopes import CALL, LARGEST, STATE_BEFORE, Directions, Step, Way, along, reached
from fpirhc.simulation.loop import close_loop, start_memory
from fpirhc.simulation.simulate import pieces
from fpirhc.status import Status
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.layout import Expression, Kind, Layout, Signal, scalar
from fpirhc.task.disturbance import Step as Jump
from fpirhc.task.problem import Problem

GAIN, POLE, FILTERED, NOISE = "map_gain", "map_pole", "map_filtered", "map_noise"  # in the memory


@dataclass(frozen=True)
class LinearMap(Deformation):
    """r+ = r - a W (f - d); behind noise and a filter r+ = r - a W g+ with g+ = p g + (1 - p)(f + n - d)."""

    gain: float  # a at the start
    weights: tuple[tuple[float, ...], ...] | None = None  # W by rows; None: the one matrix
    noisy: bool = False  # whether n and p are in the memory: n is zero again one cycle later, p is zero at the start

    @property
    def iteration(self) -> Iteration:
        """Of no limit, because a gain that a run refuses has poles too."""
        return Iteration(limited=False, weights=self.weights)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        more = (scalar(POLE), Signal(FILTERED, elements), Signal(NOISE, elements)) if self.noisy else ()
        return Layout((scalar(GAIN, start=self.gain), *more))

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        error, more = response - desired, dict[str, Expression]()
        if self.noisy:
            pole = memory[POLE]
            error = pole * memory[FILTERED] + (1 - pole) * (error + memory[NOISE])
            more = {POLE: pole, FILTERED: error, NOISE: 0 * memory[NOISE]}
        weighted = error if self.weights is None else ca.DM(self.weights) @ error
        return request - memory[GAIN] * weighted, {GAIN: memory[GAIN], **more}

    def effective_gain(self) -> float:
        return self.gain

    def secant_gain(self) -> float:
        return self.gain

    def largest_step(self) -> float:
        return float("inf")

    def with_effective_gain(self, gain: float) -> Self:
        return replace(self, gain=gain)


def near_fixed_point(controller: Controller) -> Controller:
    """Return the controller with its map as it is near the fixed point, and its optimiser as it is near a plan that is solved.

    A map that changes on line, or does not adapt, stays as it is.
    """
    if controller.planner is not None:
        optimiser = controller.planner.optimiser
        near = optimiser.near_plan
        controller = controller if near is optimiser else with_optimiser(controller, near)
    deformation = controller.deformation
    if not deformation.adapts or not deformation.iteration.constant:
        return controller
    try:
        return controller.with_deformation(linear(deformation))
    except FpirhcError:  # a controller whose map cannot be replaced
        return controller


def behind_noise(controller: Controller) -> Controller:
    """Return the controller with its map as it is near the fixed point, behind noise of the response and a filter of the error."""
    return controller.with_deformation(linear(controller.deformation, noisy=True))


def linear(deformation: Deformation, *, noisy: bool = False) -> Deformation:
    """Return the deformation with its map as a `LinearMap`."""
    if deformation.inner is None:
        return LinearMap(deformation.effective_gain(), deformation.iteration.weights, noisy)
    return with_inner(deformation, linear(deformation.inner, noisy=noisy))


_SHARE = 0.01  # of their sizes, by which states and inputs are moved to find the scales of all else
_SMALLEST = 1e-5  # scale of an entry, as a share of its value
_ROOM = 0.01  # share of the range between an input's limits, nearer than which a command stands at one
_AWAY = 1e100  # of an entry, from which a run has run away: squares of what is larger overflow
_LOOK = 50  # cycles after which a run is looked at, whether it is at rest
_STILL = 1e-7  # change of a command from period to period, as a share of the largest


@dataclass(frozen=True, eq=False)
class Passage:
    """A part of a loop's run."""

    memories: np.ndarray  # before every cycle and after the last, shape (cycles + 1, n)
    trace: np.ndarray  # of every cycle, shape (cycles, columns)


class AskedLoop:
    """A closed loop whose step is run and differentiated; it works in one thread only."""

    def __init__(self, problem: Problem, controller: Controller) -> None:
        """Compose the loop."""
        problem.require_equations("the step of a loop with a foreign reality cannot be evaluated twice at one point")
        self.problem = _CALM.of((problem,), (), lambda: _calm(problem))
        self.controller = resolved(problem, controller)
        with any_gain(), compiled_plans():  # one that a run refuses has poles too
            self.loop: Composite = close_loop(self.problem, self.controller)
        self._step = Step(self.loop, self.loop.reads.names[0])  # the disturbances of all inputs
        names = self.loop.trace.names
        self._command = self.loop.trace.slice("command")
        self._arriving = self.loop.trace.slice("arriving" if "arriving" in names else "command")
        self._statuses = [k for k, c in enumerate(self.loop.trace.columns) if c == "status"]
        self._violations = [k for k, c in enumerate(self.loop.trace.columns) if c.endswith("solve.feasibility")]
        self._errors = self.loop.trace.slice("true_error" if "true_error" in names else "error")
        self._state = self.loop.memory.slice(STATE_BEFORE)
        self._request = [k for k, c in enumerate(self.loop.memory.columns) if "_deformed_last." in c]
        self._phases = [k for k, kind in enumerate(self.loop.memory.kinds) if kind == Kind.PHASE]
        self._gains, self._poles, self._noises = (
            [k for k, c in enumerate(self.loop.memory.columns) if name in c.split(".")] for name in (GAIN, POLE, NOISE)
        )
        self._known: dict[bytes, list[Directions]] = {}  # of the points of `at`

    @property
    def quick(self) -> bool:
        """Whether a step has neither a plan nor a solver in it."""
        return self._step.scalar

    @property
    def gained(self) -> bool:
        """Whether the gain of a `LinearMap` is in the memory."""
        return bool(self._gains)

    @property
    def keeps_learned(self) -> bool:
        """Whether a model or gains that change on line stay in the linear loop what they are at its point."""
        return Kind.ADAPTED in self.loop.memory.kinds

    @cached_property
    def repeats(self) -> int:
        """Cycles after which the loop repeats itself: those between two plans."""
        return len(self._period(self.start()))

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
        changed[self._gains] = gain
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
        memories[0], end, run = memory, cycles, self._step.led
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
            if not (sizes < _AWAY).all():
                end = at + int(np.argmin(sizes < _AWAY))
                break
            if until == asked:
                memories[until, self._request] = request
            at_rest = self._at_rest(traces[:until]) if until in looks else None
            if at_rest is not None:
                end = at_rest
                break
        sent = np.isfinite(traces[:end, self._arriving]).all(axis=1)
        end = end if sent.all() else int(np.argmin(sent))
        return Passage(memories[: end + 1], traces[:end])

    def _at_rest(self, traces: np.ndarray) -> int | None:
        """The number of cycles after which commands have been still for longer than they may take; None: they have not."""
        commands, n, first = traces[:, self._command], self.repeats, self.warm + 1
        now, before = commands[first:], commands[first - n : len(commands) - n]
        with np.errstate(invalid="ignore"):
            still = (np.abs(now - before) <= _STILL * np.abs(now).max(axis=1, keepdims=True)).all(axis=1)
        counts = np.convolve(still, np.ones(self._longest + 1), "valid") if len(still) > self._longest else still[:0]
        rests = np.flatnonzero(counts > self._longest)
        return first + int(rests[0]) + self._longest + 1 if rests.size else None

    def quietest(self, passage: Passage) -> np.ndarray:
        """Return the memory in the quietest part of a run: where commands differ least from those of the period before.

        Plans are in the same phase there as at the beginning of the run. Cycles at a limit are left out as long as there are
        others: there a command has no slope.
        """
        commands, n = passage.trace[:, self._command], self.repeats
        if len(commands) <= n + 1:
            raise NoAnswer("the loop's run does not stay finite in its first cycles")
        inside = self._inside(commands)
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
        return bool(self._inside(self._step(memory)[1][self._command]))

    def feasible(self, memory: np.ndarray) -> bool:
        """Return whether the next cycle has a plan that keeps its limits of states; a loop without such a plan breaks none."""
        return bool((self._step(memory)[1][self._violations] <= FEASIBLE).all())

    def solves(self, memory: np.ndarray) -> bool:
        """Return whether the next cycle has a plan that is solved, as soft limits may be beyond theirs."""
        return all(Status(int(one)) == Status.OK for one in self._step(memory)[1][self._statuses])

    def skips(self, memory: np.ndarray) -> bool:
        """Return whether the next cycle is skipped, with the last command and every memory as it was."""
        return any(Status(int(one)).skips for one in self._step(memory)[1][self._statuses])

    def _inside(self, commands: np.ndarray) -> np.ndarray:
        """Which commands (..., nu) have room to all limits, shape (...)."""
        lower, upper = self.problem.limits.input_bounds(self.problem.plant)
        room = _ROOM * np.where(np.isfinite(upper - lower), upper - lower, 0.0)
        return np.asarray(np.all((commands > lower + room) & (commands < upper - room), axis=-1))

    def at(self, memory: np.ndarray) -> LinearLoop:
        """Return the linear loop of the period that begins at a memory; entries of long delay lines are not written out."""
        return self.late_at(memory, self._lines) if self._lines else self._among([self._period(memory)])[0]

    def late_at(self, memory: np.ndarray, lines: Sequence[np.ndarray]) -> LateLoop:
        """Return the linear loop at a memory without the entries of some delay lines."""
        scales, free = self._scales(memory), self._free.copy()
        way, acting = self._step.way(memory, scales), []
        for number, line in enumerate(lines):
            free[line] = False
            acting += [(number, k) for k in _acting(way, line, len(memory), self._step.width)]
        places = [int(lines[number][k]) for number, k in acting]
        [found] = reached([[way]], free, self._places, self._step.width, None, places)
        own = ~found.basis[places].any(axis=0) if places else np.ones(found.basis.shape[1], dtype=bool)
        onto = np.vstack([found.basis[:, own].T, np.eye(len(memory))[[line[-1] for line in lines]]])
        moved, traces, (kicked, _) = found.moved[0], found.traces[0], found.kicked[0]
        waiting = np.concatenate([line[:-1] for line in lines])
        if max(np.abs(moved[waiting][:, own]).max(initial=0.0), np.abs(kicked[waiting]).max(initial=0.0)) > _FELT:
            raise NotSupported(f"more than {LARGEST} entries of its memory move, and do not only wait")
        count, more = int(own.sum()), len(lines)
        late = []
        for (number, k), place in zip(acting, places, strict=True):
            column = int(np.argmax(np.abs(found.basis[place])))
            cycles = len(lines[number]) - 1 - k
            late.append(Late(count + number, cycles, onto @ moved[:, column], traces[self._arriving, column]))
        wide = ((0, 0), (0, more))
        state = np.pad(found.basis[self._state][:, own] * scales[self._places][:, None], wide)
        cycle = LinearCycle(
            np.pad(onto @ moved[:, own], wide), onto @ kicked, np.pad(traces[self._arriving][:, own], wide), state
        )
        placed = np.pad((found.basis[self._state][:, own] / scales[self._places][:, None]).T, ((0, more), (0, 0)))
        errors = np.pad(traces[self._errors][:, own], wide)
        return LateLoop((cycle,), errors, placed, self.problem.period, tuple(late))

    @cached_property
    def _lines(self) -> list[np.ndarray]:
        """Places of the entries of delay lines that are too long to be written out."""
        long = [np.array(places) for places in self._alike if len(places) > LARGEST]
        return [line for line in long if self._free[line].all() and self.repeats == 1]

    def noisy(self, memory: np.ndarray, correlation: np.ndarray) -> LinearLoop:
        """Return the linear loop behind the noise of the sensors, n+ = c n + w, with the commands that are sent for v.

        Args:
            correlation: c, shape (noises,); zero for white noise.
        """
        if self._noise is None:
            raise NotSupported("no sensor has noise")
        period = self._period(memory)
        ways = [[self._noise.way(at, self._scales(period[0]))] for at in period]
        directions = self._directions(ways, self._noise.width, None)
        plain = self._linear(directions, 0, self._scales(period[0])[self._places], self._command)
        return plain.with_noise([at.kicked[0][1][self._command] for at in directions], correlation)

    @cached_property
    def _noise(self) -> Step | None:
        """The step with the random series of the sensors for w."""
        drawn = self.problem.sensing.drawn
        return Step(self.loop, drawn[0].name) if drawn else None

    def between(self, memory: np.ndarray, gains: tuple[float, float], *, held: bool = False) -> tuple[LinearLoop, ...]:
        """Return the linear loops of two gains of a `LinearMap` in the same coordinates.

        What `at` has found of the second gain is not sought again.

        Args:
            held: whether plans are held for ever, as far as there are cycles between them.
        """
        period = self._period(memory)
        some = period[1:2] or period if held else period
        return self._among([[self.with_gain(one, gain) for one in some] for gain in gains])

    def shaken(self, memory: np.ndarray, corners: Sequence[tuple[float, float]]) -> tuple[LinearLoop, ...]:
        """Return linear loops behind white noise w of the response that a map sees, one for each (gain, pole of its filter)."""
        period, periods = self._period(memory), []
        for gain, pole in corners:
            moved = [self.with_gain(one, gain) for one in period]
            for one in moved:
                one[self._poles] = pole
            periods.append(moved)
        return self._among(periods)

    def _among(self, periods: list[list[np.ndarray]]) -> tuple[LinearLoop, ...]:
        """The linear loops along several periods, in the same coordinates."""
        scales, names = self._scales(periods[0][0]), [b"".join(map(bytes, period)) for period in periods]
        ways = [[self._step.way(at, scales) for at in together] for together in zip(*periods, strict=True)]
        directions = self._directions(ways, self._step.width, self._known.get(names[-1]))
        if len(periods) == 1:
            self._known[names[0]] = directions
        return tuple(self._linear(directions, k, scales[self._places], self._arriving) for k in range(len(periods)))

    @property
    def _places(self) -> np.ndarray:
        """Places of the plant's state."""
        return np.arange(self._state.start, self._state.stop)

    def _directions(self, ways: list[list[Way]], width: int, begun: list[Directions] | None) -> list[Directions]:
        if self.quick:
            return [along(some, np.eye(self._free.size)[:, self._free], width) for some in ways]
        with np.errstate(invalid="ignore", over="ignore"):  # a loop that runs away is infinite on both sides
            return reached(ways, self._free, self._places, width, begun, self._noises)

    def _linear(self, directions: list[Directions], number: int, scales: np.ndarray, sent: slice) -> LinearLoop:
        """The linear loop of one of the ways of every cycle, and the commands in one place of the trace."""
        cycles, shaken = [], None if self._sizes is None else self._sizes[self._noises]
        for at, later in zip(directions, [*directions[1:], directions[0]], strict=True):
            state, onto, kicked = at.basis[self._state] * scales[:, None], later.basis.T, at.kicked[number][0]
            entry = onto @ kicked if not self._noises else onto[:, self._noises] / shaken
            cycles.append(LinearCycle(onto @ at.moved[number], entry, at.traces[number][sent], state))
        first = directions[0]
        placed = (first.basis[self._state] / scales[:, None]).T
        return LinearLoop(tuple(cycles), first.traces[number][self._errors], placed, self.problem.period)

    @cached_property
    def _longest(self) -> int:
        """Cycles that a command may take through the loop before anything of it is seen."""
        return 2 * self.repeats + 2 * math.ceil(self.problem.response_delay) + 2

    @cached_property
    def warm(self) -> int:
        """Cycles before which no deformation acts, or no command has gone all the way."""
        return self._longest + math.ceil(self.problem.warm_up_cycles)

    def _period(self, memory: np.ndarray) -> list[np.ndarray]:
        """The memories of as many cycles as pass until the phases of plans are the same again."""
        memories, passed = [memory], {memory[self._phases].tobytes()}
        while True:
            memory_next, _ = self._step(memories[-1])
            if np.array_equal(memory_next[self._phases], memory[self._phases]):
                return memories
            if not np.isfinite(memory_next).all():
                raise NoAnswer("the loop's run does not stay finite from one plan to the next")
            phases = memory_next[self._phases].tobytes()
            if phases in passed:  # a cycle that is skipped for ever
                raise NoAnswer("the loop's run does not come to its next plan")
            memories.append(memory_next)
            passed.add(phases)

    @cached_property
    def _free(self) -> np.ndarray:
        """Entries that may deviate: all states that are no parameters."""
        fixed = np.array([kind != Kind.STATE for kind in self.loop.memory.kinds])
        for name in ("_exact", "parameters"):
            fixed[self.loop.memory.slice(name)] = True
        fixed[self._gains] = True
        return ~fixed

    def _scales(self, memory: np.ndarray) -> np.ndarray:
        """The size by which every entry deviates at the first point where states and inputs deviate by their own sizes."""
        if self._sizes is None:
            self._sizes = self._deviations(memory)
        return self._sizes

    _sizes: np.ndarray | None = None

    def _deviations(self, memory: np.ndarray) -> np.ndarray:
        lower, upper = self.problem.limits.input_bounds(self.problem.plant)
        inputs = np.where(np.isfinite(upper - lower), (upper - lower) / 2, 1.0)
        moved = memory.copy()
        moved[self._state] *= 1 + _SHARE
        largest = np.abs(moved - memory)
        for start, w in ((moved, 0.0), (memory, _SHARE * inputs)):
            one, other = start, memory
            for k in range(2 * self._longest):
                one, other = self._step(one, w if k == 0 else 0.0)[0], self._step(other)[0]
                with np.errstate(invalid="ignore"):  # both may have run away
                    deviation = np.abs(one - other)
                largest = np.maximum(largest, np.where(deviation < _AWAY, deviation, 0.0))
        scales = np.maximum(largest / _SHARE, _SMALLEST * np.abs(memory))
        for places in self._alike:
            scales[places] = scales[places].max()
        scales[scales == 0] = 1.0
        return scales

    @cached_property
    def _alike(self) -> list[list[int]]:
        """Places of entries that are the same quantity at other times: those of a queue, or of a plan's stages."""
        groups: dict[str, list[int]] = {}
        for k, column in enumerate(self.loop.memory.columns):
            groups.setdefault(column.split("@")[0], []).append(k)
        return [places for places in groups.values() if len(places) > 1]


_FELT = 1e-7  # of a deviation


def _acting(way: Way, line: np.ndarray, size: int, inputs: int) -> list[int]:
    """Which entries of a delay line, the oldest first, do more than wait; sought by halves, because few do."""
    random = np.random.default_rng(0).standard_normal(len(line))

    def felt(some: range) -> bool:
        deviation = np.zeros((size, 1))
        deviation[line[some], 0] = random[some]
        moved, traces = way(deviation, np.zeros((inputs, 1)))
        moved[line[:-1]] -= deviation[line[1:]]
        return bool(max(np.abs(moved).max(), np.abs(traces).max()) > _FELT)

    found, sought = [], [range(len(line))]
    while sought:
        some = sought.pop()
        if felt(some):
            half = len(some) // 2
            found += [some[0]] if not half else []
            sought += [some[:half], some[half:]] if half else []
    return sorted(found)


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
