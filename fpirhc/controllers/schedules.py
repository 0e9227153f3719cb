"""Schedules of time slots: which slot a control cycle belongs to.

    FixedSchedule  spans of time, given one by one
    Periodic       durations, repeated
    ByError        at the end of a slot, the coordinate with the largest weighted error
    ByLookAhead    at the end of a slot, the slot whose linearised closed loop brings the state closest in one dwell

Every slot begins with a control cycle: times are rounded to whole cycles. The last two choose only among admissible slots, those
whose gain d y^(r)/du is large enough.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg

from fpirhc.controllers.base import error_signal, like
from fpirhc.controllers.slot import Channel
from fpirhc.controllers.slot_modes import linear_modes
from fpirhc.errors import Mistakes, NotSupported
from fpirhc.problem import Problem
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

_NEVER = -1e300  # score of a slot that may not be chosen
Spans = tuple[tuple[str, float], ...]


class Schedule(ABC):
    """Contract: which slot is active, cycle by cycle."""

    @abstractmethod
    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        """Note every mistake of the schedule for slots of these coordinates."""

    @abstractmethod
    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """How long each slot may last at least at a stretch, s: the longest of its known stretches."""

    def sequence(self, problem: Problem) -> Spans:  # noqa: ARG002
        """One period as (coordinate, duration in s); empty where the schedule is not periodic."""
        return ()

    @abstractmethod
    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Block (time, error, state, reference, _slot_before, _age_before, _admissible, started) -> slot, its number."""


@dataclass(frozen=True)
class FixedSchedule(Schedule):
    """Slots at given times.

    Parameters:
        spans: (coordinate, start, end) in s, without gaps from 0 s to the end of the run.
    """

    spans: Sequence[tuple[str, float, float]]

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        """Note unknown coordinates, overlaps, gaps, and spans beyond the run."""
        mistakes.unknown("FixedSchedule: coordinate", [c for c, _, _ in self.spans], names)
        at, half = 0.0, 0.5 * problem.period
        for name, start, end in sorted(self.spans, key=lambda span: span[1]):
            if not end - start >= problem.period - 1e-9:
                mistakes.add(f"FixedSchedule: '{name}' from {start:g} to {end:g} s is shorter than one control cycle")
            if start < at - half:
                mistakes.add(
                    f"FixedSchedule: '{name}' starts at {start:g} s, before the slot ahead of it ends ({at:g} s)"
                )
            elif start > at + half:
                mistakes.add(f"FixedSchedule: no slot from {at:g} to {start:g} s; close the gap")
            at = end
        if at > problem.duration + half:
            mistakes.add(f"FixedSchedule: the last slot ends at {at:g} s, after the run's {problem.duration:g} s")
        elif at < problem.duration - half:
            mistakes.add(f"FixedSchedule: no slot from {at:g} s to the end of the run at {problem.duration:g} s")

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """The longest span of each coordinate."""
        del problem
        return {n: max((end - start for c, start, end in self.spans if c == n), default=0.0) for n in names}

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Block time -> slot."""
        ordered = sorted(self.spans, key=lambda span: span[1])
        starts = [(name, start / problem.period) for name, start, _ in ordered]
        return _timed(problem, channels, starts, math.inf)


@dataclass(frozen=True, eq=False)
class Periodic(Schedule):
    """Slots in turn, again and again.

    Parameters:
        durations: coordinate -> s, in the order of the slots.
    """

    durations: Mapping[str, float]

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        """Note unknown coordinates and durations that are not positive or shorter than a cycle."""
        mistakes.unknown("Periodic: coordinate", self.durations, names)
        if not self.durations:
            mistakes.add("Periodic has no durations; name at least one coordinate")
        for name, duration in self.durations.items():
            _check_stretch(f"Periodic: duration of '{name}'", duration, problem, mistakes)

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """The durations; alone, a slot lasts as long as the run."""
        if len(self.durations) == 1:
            return dict.fromkeys(self.durations, problem.duration)
        return {n: self.durations.get(n, 0.0) for n in names}

    def sequence(self, problem: Problem) -> Spans:
        """One period, in whole cycles."""
        return tuple((n, round(d / problem.period) * problem.period) for n, d in self.durations.items())

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Block time -> slot."""
        starts, at = [], 0
        for name, duration in self.durations.items():
            starts.append((name, float(at)))
            at += round(duration / problem.period)
        return _timed(problem, channels, starts, at)


@dataclass(frozen=True, eq=False)
class ByError(Schedule):
    """The coordinate with the largest weighted error is next.

    A slot that has lasted `dwell` ends in the first cycle in which some admissible slot has w|e| above (1 + hysteresis) times
    that of the active one.

    Parameters:
        weights: coordinate -> weight, in 1 / unit of the coordinate. dwell: shortest duration of a slot, s.
        hysteresis: by how much another weighted error must be larger, relative.
    """

    weights: Mapping[str, float]
    dwell: float
    hysteresis: float = 0.1

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        """Note unknown or missing weights and what is out of range."""
        mistakes.unknown("ByError: weight of coordinate", self.weights, names)
        for name in names:
            if not self.weights.get(name, 0.0) > 0:
                mistakes.add(
                    f"ByError: the weight of '{name}' must be a positive number, got {self.weights.get(name)!r}"
                )
        _check_choice("ByError", self.dwell, self.hysteresis, problem, mistakes)

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """The shortest duration of a slot."""
        del problem
        return dict.fromkeys(names, self.dwell)

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Block (error, ...) -> slot."""
        weights = [self.weights[c.slot.coordinate] for c in channels]
        places = [problem.judged_names.index(c.slot.coordinate) for c in channels]

        def score(s: Any) -> list[Expression]:
            return [w * ca.fabs(s.error[k]) for w, k in zip(weights, places, strict=True)]

        return _chosen(problem, channels, score, self.dwell, self.hysteresis)


@dataclass(frozen=True, eq=False)
class ByLookAhead(Schedule):
    """The slot that brings the state closest to the reference within one dwell, by the linearised closed loop, is next.

        argmin_j V(e^(A_j T) (x - x^N)),    V(x) = sum w x^2,   T = dwell

    A slot that has lasted `dwell` ends in the first cycle in which some admissible slot's V is below that of the active one by
    the share that the hysteresis says. The matrices A_j are the model's at the reference's last point.

    Parameters:
        weights: state -> weight of its square. dwell: shortest duration of a slot, s.
        hysteresis: by how much the active slot's V must exceed the best one's, relative.
    """

    weights: Mapping[str, float]
    dwell: float
    hysteresis: float = 0.1

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        """Note unknown weights and what is out of range."""
        del names
        mistakes.unknown("ByLookAhead: weight of state", self.weights, problem.plant.state.elements)
        if not self.weights or not all(w >= 0 for w in self.weights.values()) or not any(self.weights.values()):
            mistakes.add("ByLookAhead: weights must be numbers of at least 0, one of them positive")
        _check_choice("ByLookAhead", self.dwell, self.hysteresis, problem, mistakes)

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """The shortest duration of a slot."""
        del problem
        return dict.fromkeys(names, self.dwell)

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Block (state, reference, ...) -> slot.

        Raises:
            NotSupported: the closed loops cannot be linearised at the reference's last point.
        """
        modes, reason = linear_modes(problem, channels, problem.plant.approximate, 0.0)
        if reason:
            raise NotSupported(f"ByLookAhead: {reason}; use ByError")
        n = problem.plant.state.size
        weight = np.diag([self.weights.get(e, 0.0) for e in problem.plant.state.elements])
        moved = [(scipy.linalg.expm(m.generator * self.dwell) @ m.start(m))[:n, :n] for m in modes]
        forms = [phi.T @ weight @ phi for phi in moved]

        def score(s: Any) -> list[Expression]:
            away = s.state - s.reference
            return [-ca.bilin(ca.DM(form), away, away) for form in forms]

        return _chosen(problem, channels, score, self.dwell, self.hysteresis)


def _check_stretch(what: str, value: float, problem: Problem, mistakes: Mistakes) -> None:
    if not (isinstance(value, int | float) and math.isfinite(value) and value > 0):
        mistakes.add(f"{what} must be a positive number of seconds, got {value!r}")
    elif value < problem.period * (1 - 1e-9):
        mistakes.add(f"{what} is {value:g} s, shorter than one control cycle of {problem.period:g} s")


def _check_choice(owner: str, dwell: float, hysteresis: float, problem: Problem, mistakes: Mistakes) -> None:
    _check_stretch(f"{owner}: dwell", dwell, problem, mistakes)
    if not (isinstance(hysteresis, int | float) and 0 <= hysteresis < math.inf):
        mistakes.add(f"{owner}: hysteresis must be a number of at least 0, got {hysteresis!r}")


def _timed(problem: Problem, channels: Sequence[Channel], starts: Sequence[tuple[str, float]], cycles: float) -> Block:
    """Block time -> slot from the cycles in which slots start, repeated after `cycles`."""
    numbers = {c.slot.coordinate: c.number for c in channels}
    order = [numbers[name] for name, _ in starts]

    def step(s: Any) -> dict[str, Expression]:
        cycle = ca.floor(s.time / problem.period + 0.5)
        phase = ca.fmod(cycle, cycles) if math.isfinite(cycles) else cycle
        slot = ca.SX(order[0])
        for before, number, (_, start) in zip(order, order[1:], starts[1:], strict=False):
            slot += (number - before) * (phase > start - 0.5)
        return {"slot": slot}

    return Block("schedule", Layout((scalar("time", "s"),)), Layout((scalar("slot"),)), step)


def _chosen(problem: Problem, channels: Sequence[Channel], score: Any, dwell: float, hysteresis: float) -> Block:
    """Block that stays with a slot for the dwell and then leaves it for an admissible one whose score is clearly larger."""
    plant = problem.plant
    names = tuple(c.slot.coordinate for c in channels)
    reads = (
        error_signal(problem, "error"),
        plant.state,
        like(plant.state, "reference"),
        scalar("_slot_before"),
        scalar("_age_before"),
        scalar("started"),
        Signal("_admissible", names),
    )
    shortest = round(dwell / problem.period)

    def step(s: Any) -> dict[str, Expression]:
        scores = [ca.if_else(s._admissible[k] > 0.5, v, _NEVER) for k, v in enumerate(score(s))]
        best, slot, active = scores[0], ca.SX(0), scores[0]
        for k, value in enumerate(scores[1:], 1):
            slot, best = ca.if_else(value > best, k, slot), ca.fmax(best, value)
            active = ca.if_else(s._slot_before > k - 0.5, value, active)
        clear = best - active > hysteresis * ca.fmin(ca.fabs(best), ca.fabs(active))
        free = ca.logic_and(s._age_before + 1 > shortest - 0.5, clear)
        return {"slot": ca.if_else(ca.logic_or(s.started < 0.5, free), slot, s._slot_before)}

    return Block("schedule", Layout(reads), Layout((scalar("slot"),)), step)
