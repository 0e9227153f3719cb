"""The time of the samples: which command, and which signals from outside, acted until a late sample was taken.

A belief lives in the time of the samples. Behind a measurement that is late by d + phi cycles, 0 <= phi < 1, a sample is
interpolated,

    z_k = (1 - phi) x_{k-d} + phi x_{k-d-1},

and moves as the plant does with the mean of the commands that acted, (1 - phi) u_{k-d-1} + phi u_{k-d-2}. For a linear plant this
is exact; else the error is of second order in the cycle, as that of the interpolation. The first sample that moves is a mean with
the start, so it moves by 1 - phi of a cycle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import casadi as ca

from fpirhc.controllers.outside_block import Told
from fpirhc.deformation.queue import Queue
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Signal, scalar
from fpirhc.task.problem import Problem

COMMANDED = "_commanded"  # the last command
_COUNT, _QUEUE, _SIGNALS = "belief_cycles", "belief_commands", "belief_signals"
_WHOLE = 1e-6  # a fraction of a cycle below this counts as zero


@dataclass(frozen=True, eq=False)
class SampleTime:
    """What acted until a sample was taken.

    Args:
        problem: whose measurements may be late.
    """

    problem: Problem

    @property
    def late(self) -> int:
        """Whole cycles of the measurement's dead time."""
        return math.floor(self._cycles + _WHOLE)

    @property
    def fraction(self) -> float:
        """The rest of the measurement's dead time, in cycles."""
        rest = self._cycles - self.late
        return rest if rest > _WHOLE else 0.0

    @property
    def commanded(self) -> Signal:
        """Signal of the last command."""
        inputs = self.problem.plant.input
        return Signal(COMMANDED, inputs.elements, inputs.units, tuple(map(float, self.problem.inputs_before)))

    @property
    def reads(self) -> tuple[Signal, ...]:
        """The last command, the parameters, and the signals of the last cycle."""
        return (self.problem.plant.parameter, self.commanded, *self._told.reads)

    @property
    def memory(self) -> tuple[Signal, ...]:
        """The number of cycles so far, older commands, and older signals."""
        elements, length = self.commanded.elements, self._length
        names = tuple(f"{e}@{k}" for k in range(1, length) for e in elements)
        queued = (Signal(_QUEUE, names, start=self.commanded.start * (length - 1)),) if length > 1 else ()
        return (scalar(_COUNT), *queued, *self._told.memory(self.late, _SIGNALS))

    def command(self, s: Signals) -> tuple[Expression, dict[str, Expression]]:
        """Return the command that acted, and what is remembered."""
        size, newest, length = self.problem.plant.input.size, getattr(s, COMMANDED), self._length
        count, column, remembered = getattr(s, _COUNT), newest, {}
        remembered[f"{_COUNT}_next"] = ca.fmin(count + 1, self.late + (2 if self.fraction else 1))
        if length > 1:
            column = ca.vertcat(newest, getattr(s, _QUEUE))
            remembered[f"{_QUEUE}_next"] = column[: size * (length - 1)]
        acted = self._queue(0).delayed(column, size)
        if self.fraction:
            mean = (1 - self.fraction) * acted + self.fraction * self._queue(1).delayed(column, size)
            acted = ca.if_else(count > self.late + 1.5, mean, acted)
        return acted, remembered

    def parameters(self, s: Signals) -> tuple[Expression, dict[str, Expression]]:
        """Return the model's parameters with the signals from outside that acted, and what is remembered."""
        return self._told.acted(s, self.late, _SIGNALS)

    def moves(self, s: Signals) -> Expression:
        """Return the share of a cycle by which the sample is later than the last one."""
        count = getattr(s, _COUNT)
        later = count > self.late + 0.5
        if not self.fraction:
            return later
        return ca.if_else(count > self.late + 1.5, 1, (1 - self.fraction) * later)

    def counts(self, s: Signals) -> Expression:
        """Return whether the sample was taken in this run."""
        return getattr(s, _COUNT) > self.late - 0.5

    @property
    def _cycles(self) -> float:
        return self.problem.dead_time.measurement / self.problem.period

    @property
    def _told(self) -> Told:
        return Told(self.problem.plant, self.problem.signals, self.problem.period)

    def _queue(self, more: int) -> Queue:
        """Queue of the commands: the newest one is that of the last cycle, and acts on the sample's cycle after all dead times."""
        names, late = self.problem.plant.inputs, self.late + more
        waits = [self.problem.dead_time.wait(name, self.problem.period) for name in names]
        room = max((wait.room for wait in waits), default=0.0)
        return Queue(tuple(cast(float, wait.cycles + late) for wait in waits), longest=room + late if room else None)

    @property
    def _length(self) -> int:
        return self._queue(1 if self.fraction else 0).length
