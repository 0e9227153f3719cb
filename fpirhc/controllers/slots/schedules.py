"""Schedules of time slots: which slot a control cycle belongs to. Theory: docs/theory.md."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca

from fpirhc.controllers.slots.slot import Channel
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
    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """Return the longest stretch of each slot that is certain before a run, s, by coordinate."""

    def sequence(self, problem: Problem) -> tuple[tuple[str, float], ...]:  # noqa: ARG002
        """Return one period as (coordinate, duration in s); empty where the schedule is not periodic."""
        return ()

    @abstractmethod
    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Return a Block -> slot, its number."""


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

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        if len(self.durations) == 1:
            return dict.fromkeys(self.durations, problem.duration)
        return {n: self.durations.get(n, 0.0) for n in names}

    def sequence(self, problem: Problem) -> tuple[tuple[str, float], ...]:
        return tuple((n, round(d / problem.period) * problem.period) for n, d in self.durations.items())

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Return Block time -> slot."""
        starts, at = [], 0.0
        for name, duration in self.durations.items():
            starts.append((name, at))
            at += round(duration / problem.period)
        numbers = {c.slot.coordinate: c.number for c in channels}
        order = [numbers[name] for name, _ in starts]

        def step(s: Signals) -> dict[str, Expression]:
            cycle = ca.floor(s.time / problem.period + 0.5)
            phase, slot = ca.fmod(cycle, at), ca.SX(order[0])
            for before, number, (_, start) in zip(order, order[1:], starts[1:], strict=False):
                slot += (number - before) * (phase > start - 0.5)
            return {"slot": slot}

        return Block("schedule", Layout((time_signal(problem.plant),)), Layout((scalar("slot"),)), step)
