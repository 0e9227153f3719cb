"""Schedules of time slots: whose turn a control cycle is. Theory: docs/theory.md."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca

from fpirhc.errors import Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import finite_number
from fpirhc.plant.motion import time_signal
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, scalar
from fpirhc.task.problem import Problem


class Schedule(Checked, ABC):
    """Contract: which slot is active, cycle by cycle."""

    @abstractmethod
    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        """Note every mistake of the schedule for slots of these coordinates."""

    @abstractmethod
    def block(self, names: Sequence[str], problem: Problem) -> Block:
        """Return a Block -> slot, its place among the names."""


@dataclass(frozen=True, eq=False)
class Periodic(Schedule):
    """Slots in turn, again and again.

    Args:
        durations: coordinate -> s, in the order of the slots.
    """

    durations: Mapping[str, float] = field(metadata={"structure": True})

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        mistakes.unknown("Periodic: coordinate", self.durations, names)
        for name in names:
            if name not in self.durations and {*self.durations} <= {*names}:
                mistakes.add(f"Periodic: slot '{name}' is never active; give it time, or leave the slot out")
        unit = problem.time_unit
        for name, value in self.durations.items():
            what = f"Periodic: duration of '{name}'"
            if not (finite_number(value) and value > 0):
                mistakes.add(f"{what} must be a positive number, in {unit}, got {value!r}")
            elif value < problem.period * (1 - 1e-9):
                mistakes.add(f"{what} is {value:g} {unit}, shorter than one control cycle of {problem.period:g} {unit}")

    def block(self, names: Sequence[str], problem: Problem) -> Block:
        """Return Block time -> slot."""
        starts, at = [], 0.0
        for duration in self.durations.values():
            starts.append(at)
            at += round(duration / problem.period)
        order = [names.index(name) for name in self.durations]

        def step(s: Signals) -> dict[str, Expression]:
            cycle = ca.floor(s.time / problem.period + 0.5)
            phase, slot = ca.fmod(cycle, at), ca.SX(order[0])
            for before, number, start in zip(order, order[1:], starts[1:], strict=False):
                slot += (number - before) * (phase > start - 0.5)
            return {"slot": slot}

        return Block("schedule", Layout((time_signal(problem.plant),)), Layout((scalar("slot"),)), step)
