"""The believed way of the commands to the model: dead time of every input, then the actuators' lag."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.exogenous_block import KnownSignals
from fpirhc.deformation.base import Mirror
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.functions import left_after, left_in_mean, numbers, stays
from fpirhc.symbolic.layout import Expression, Signal, scalar
from fpirhc.symbolic.queue import Queue, every
from fpirhc.task.problem import Problem

MEASURED_OUTPUT = "_measured_output"  # the outputs of the same instant
MEASURED = "_measured_state"  # the state that the response belongs to, where a controller may act on a predicted one
MEASURED_TIME = "_measured_time"  # the time at which it is given, where a controller may act on a predicted one
NONE = 1e-9  # a fraction of a cycle below this counts as zero


def measured_state(plant: Plant) -> Signal:
    """Return the signal of the measured state."""
    return Signal(MEASURED, plant.state.elements, plant.state.units)


def measured_output(plant: Plant) -> Signal:
    """Return the signal of the measured outputs."""
    return Signal(MEASURED_OUTPUT, plant.output.elements, plant.output.units)


@dataclass(frozen=True, eq=False)
class Path:
    """The believed way from the commands to the model.

    The whole cycles of the measurement's dead time come before the model: the twin runs in the time of the samples.

    Args:
        problem: the problem.
        mirror: the beliefs.
        counts: whether the first cycles differ from the others.
    """

    problem: Problem
    mirror: Mirror
    counts: bool

    @property
    def known(self) -> KnownSignals:
        """What the model is told of signals from outside."""
        return KnownSignals(self.problem.plant, self.problem.signals, self.problem.period)

    @property
    def late(self) -> int:
        """Whole cycles of the measurement's dead time."""
        return math.floor(self.mirror.measurement + NONE)

    @property
    def fraction(self) -> float:
        """The rest of the measurement's dead time, in cycles."""
        rest = self.mirror.measurement - self.late
        return rest if rest > NONE else 0.0

    @property
    def decays(self) -> tuple[float, ...]:
        """Share of an actuator's distance from its command that is left after one cycle; empty where none lags."""
        taus = every(self.mirror.lag)
        lags = not all(stays(t, 0.0) for t in taus)
        return tuple(left_after(self.problem.period, t) for t in taus) if lags else ()

    @property
    def queue(self) -> Queue:
        """Queue of the commands; the newest one is that of the last cycle."""
        cycles, longest = self.mirror.cycles, self.mirror.longest
        delays = tuple(c + self.late for c in cycles) if isinstance(cycles, tuple) else cycles + self.late
        return Queue(delays, longest=None if longest is None else longest + self.late)

    @property
    def memory(self) -> tuple[Signal, ...]:
        """Commands on their way, positions of lagging actuators, and the number of cycles so far."""
        plant, length = self.problem.plant, self.queue.length
        start = tuple(map(float, self.problem.inputs_before))
        names = tuple(f"{e}@{k}" for k in range(1, length) for e in plant.input.elements)
        queued = (Signal("mirror_commands", names, start=start * (length - 1)),) if length > 1 else ()
        lagging = (Signal("mirror_actuators", plant.input.elements, plant.input.units, start),) if self.decays else ()
        counted = (scalar("mirror_cycles"),) if self.counts else ()
        return (*queued, *lagging, *counted, *self.known.memory(self.late))

    @property
    def reads(self) -> tuple[Signal, ...]:
        """Signals that every mirror reads."""
        plant = self.problem.plant
        before = Signal("_command_before", plant.input.elements, plant.input.units)
        return measured_state(plant), before, plant.parameter, *self.known.reads

    def acted(self, s: Signals) -> tuple[Expression, Expression, dict[str, Expression]]:
        """Return the input that acted in the last cycle, at its end and in the mean, and what is remembered."""
        size, newest = self.problem.plant.input.size, s._command_before
        remembered: dict[str, Expression] = {}
        if self.counts:
            first = ca.DM(self.problem.inputs_before)
            newest = ca.if_else(s.mirror_cycles < 0.5, first, newest)
            remembered["mirror_cycles_next"] = ca.fmin(s.mirror_cycles + 1, self.late + 1)
        column = newest
        if self.queue.length > 1:
            column = ca.vertcat(newest, s.mirror_commands)
            remembered["mirror_commands_next"] = column[: size * (self.queue.length - 1)]
        arrived = self.queue.delayed(column, size)
        if not self.decays:
            return arrived, arrived, remembered
        decay = numbers(self.decays, arrived)
        share = numbers([left_in_mean(self.problem.period, t) for t in every(self.mirror.lag)], arrived)
        away = s.mirror_actuators - arrived
        end = arrived + decay * away
        return end, arrived + share * away, {**remembered, "mirror_actuators_next": end}
