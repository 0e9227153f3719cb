"""The time of one control cycle: the controller alone, from measurement to command."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.simulation.run import Run
from fpirhc.simulation.step_arguments import raw_measurements
from fpirhc.simulation.stepper import ComposedStep, Stepper
from fpirhc.task.problem import Problem, cycles_per_plan

REPLAYED = 2000  # cycles of the run that are stepped again, one by one
ROUNDS = 40  # in which two controllers are timed in turn
_TURN = 250  # cycles of a turn: the first one, whose code another controller has displaced, is no 99th percentile
_FEWEST = 10  # rounds from which a median has an interval
_PLACEMENT = 0.03  # of a time: where code and data happen to lie changes it by this much


@dataclass(frozen=True)
class CycleTime:
    """Wall time of one call of `Stepper.step`, microseconds; only `first` includes the first call."""

    median: (
        float  # median of the mean over the cycles from one plan to the next, so that it includes its share of planning
    )
    p99: float  # 99th percentile
    maximum: float  # largest time
    first: float  # time of the first call
    planning: float  # median of the cycles in which a new plan is made; of all cycles where no plan is made


@dataclass(frozen=True)
class Price:
    """The time per cycle of one controller beyond that of another, microseconds.

    Args:
        beside: name of the other controller.
        difference: median over the rounds in which both were timed, one directly after the other.
        noise: half width of the 95 % interval of this median, at least 3 % of the time itself; a smaller difference is none.
    """

    beside: str
    difference: float
    noise: float


def measure_price(problem: Problem, plain: tuple[Stepper, Run], adaptive: tuple[Stepper, Run]) -> Price | None:
    """Replay two runs in turn, and return how much longer a cycle of the adaptive controller takes.

    Other work on the machine slows both alike, because they take turns, now one first and now the other; what is left is the noise.
    The result is None for runs of fewer than ten plans.
    """
    cycles = min(plain[1].cycles, adaptive[1].cycles, REPLAYED)
    stride = cycles_per_plan(problem.horizon, problem.period) if problem.horizon else 1
    block = max(cycles // ROUNDS // stride, 1) * stride  # whole periods of the plan
    rounds = cycles // block
    if rounds < _FEWEST:
        return None
    replays = [_Replay(*one) for one in (plain, adaptive)]
    times = np.empty((rounds, 2))
    for number in range(rounds):
        for k in (0, 1) if number % 2 else (1, 0):
            times[number, k] = replays[k].micro(block)
    return price_of(plain[1].controller, times)


def price_of(beside: str, times: np.ndarray) -> Price:
    """Return the price that these times of both controllers show.

    The interval of the median is that of the sign test, between the order statistics n/2 - sqrt(n) and n/2 + sqrt(n); single
    rounds that were interrupted do not widen it.

    Args:
        times: of a cycle, microseconds, shape (rounds, 2).
    """
    differences = np.sort(times[:, 1] - times[:, 0])
    outer = max(int(differences.size / 2 - np.sqrt(differences.size)), 0)
    half = float(differences[-1 - outer] - differences[outer]) / 2
    return Price(beside, float(np.median(differences)), max(half, _PLACEMENT * float(np.median(times[:, 0]))))


class _Replay:
    """A controller on the measurements of its run, block by block."""

    def __init__(self, stepper: Stepper, run: Run) -> None:
        self._step, self._memory, self._at = _step_of(stepper), stepper.start(), 0
        self._signals = run.time, *_samples(stepper, run)

    def micro(self, block: int) -> float:
        """The mean time of a cycle over the next block; the median would hide cycles that plan."""
        times, states, realised = (signal[self._at : self._at + block] for signal in self._signals)
        begin = time.perf_counter_ns()
        for k in range(block):
            _, self._memory = self._step(times[k], states[k], realised[k], self._memory)
        self._at += block
        return (time.perf_counter_ns() - begin) / 1e3 / block


def _samples(stepper: Stepper, run: Run) -> tuple[np.ndarray, np.ndarray]:
    """States, with outputs where there are some, and responses of a run; raw measurements and nothing for one that estimates."""
    if not stepper.estimates:
        state = run["state"]
        return (np.hstack([state, run["output"]]) if "output" in run.layout else state), run["realised"]
    measured = raw_measurements(run)
    return measured, measured[:, :0]


def _step_of(stepper: Stepper) -> Callable[[float, np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    if not stepper.estimates and not stepper.beside:
        return stepper.step
    if not stepper.estimates:
        size = stepper.beside
        return lambda now, seen, realised, memory: stepper.step(
            now, seen[:-size], realised, memory, output=seen[-size:]
        )
    if stepper.beside:  # by itself: `step_measured` would have to split the sample in every cycle
        size = stepper.beside
        return lambda now, seen, realised, memory: stepper.step(now, seen[size:], realised, memory, output=seen[:size])
    return lambda now, measured, _, memory: stepper.step_measured(now, measured, memory)


def stepper_to_time(problem: Problem, controller: Controller, *, compiled: bool) -> Stepper:
    """Return the controller stepped by hand: not warned of, because a comparison judges it, and with any optimiser."""
    return Stepper.of(step_to_time(problem, controller), compiled=compiled)


def step_to_time(problem: Problem, controller: Controller) -> ComposedStep:
    """Return the step of that stepper, before it is compiled."""
    return ComposedStep.of(problem, controller, bounded=False)


def measure_cycle(problem: Problem, stepper: Stepper, run: Run) -> CycleTime | None:
    """Return the times of one controller, see `measure_cycles`."""
    return measure_cycles(problem, [(stepper, run)])[0]


def measure_cycles(problem: Problem, ran: Sequence[tuple[Stepper, Run]]) -> list[CycleTime | None]:
    """Replay the measurements of runs through their controllers, one call per cycle, and return the times.

    A replay repeats the computations of its run: the controller starts afresh and has the same measurements. The controllers take
    turns, so that other work on the machine slows all of them alike. The result is None for a run of fewer than two cycles.
    """
    timed = [_Timed(*one) for one in ran]
    for number in range(-(-REPLAYED // _TURN)):
        for one in timed[:: -1 if number % 2 else 1]:
            one.advance(_TURN)
    return [one.times(problem) for one in timed]


class _Timed:
    """A controller on the measurements of its run, every cycle timed."""

    def __init__(self, stepper: Stepper, run: Run) -> None:
        self._stepper, self._step, self._memory, self._at = stepper, _step_of(stepper), stepper.start(), 0
        self._cycles, self._plans = min(run.cycles, REPLAYED), "solve" in run.layout
        self._signals = run.time, *_samples(stepper, run)
        self._taken, self._skipped = np.empty(self._cycles), np.empty(self._cycles)

    def advance(self, cycles: int) -> None:
        """Replay the next cycles, as far as there are some."""
        times, states, realised = self._signals
        for k in range(self._at, min(self._at + cycles, self._cycles)):
            begin = time.perf_counter_ns()
            _, self._memory = self._step(times[k], states[k], realised[k], self._memory)
            self._taken[k] = time.perf_counter_ns() - begin
            self._skipped[k] = self._stepper.skipped
        self._at += cycles

    def times(self, problem: Problem) -> CycleTime | None:
        """The times of all cycles."""
        if self._cycles < 2:
            return None
        micro, cycles = self._taken / 1e3, self._cycles
        later = micro[1:]
        stride = cycles_per_plan(problem.horizon, problem.period) if problem.horizon and self._plans else 1
        plans = micro[_planned(self._skipped, stride)] if cycles > stride else micro
        # Whole plan periods: where every other cycle plans, the median of single cycles would be the one or the other by chance.
        whole = later[: later.size - later.size % stride] if later.size >= stride else later
        periods = whole.reshape(-1, stride) if later.size >= stride else whole[:, None]
        return CycleTime(
            median=float(np.median(periods.mean(axis=1))),
            p99=float(np.quantile(later, 0.99)),
            maximum=float(later.max()),
            first=float(micro[0]),
            planning=float(np.median(plans)),
        )


def _planned(skipped: np.ndarray, stride: int) -> np.ndarray:
    """Which cycles make a new plan, the first one left out: a skipped cycle keeps the memory, and with it the count to the plan."""
    ran = np.diff(skipped, prepend=0) == 0
    due = ran & ((np.arange(skipped.size) - skipped) % stride == 0)
    due[0] = False
    return np.asarray(due)
