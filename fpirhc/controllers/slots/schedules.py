"""Schedules of time slots: which slot a control cycle belongs to. Theory: docs/theory-rivals.md."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeGuard

import casadi as ca
import numpy as np

from fpirhc.controllers.base import error_signal, like
from fpirhc.controllers.reference_states import reference_states
from fpirhc.controllers.slots.slot import Channel
from fpirhc.errors import Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import finite_number
from fpirhc.horizon.nominal import reference_state
from fpirhc.plant.maps import growth_of, rate_of_decay, step_of
from fpirhc.plant.motion import time_signal
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import FINITE, Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import expressed, following, live_numbers, nominal, rounded, settled
from fpirhc.task.problem import Problem

SlotSpans = tuple[tuple[str, float], ...]


class Schedule(Checked, ABC):
    """Contract: which slot is active, cycle by cycle."""

    foresees: ClassVar[bool] = False  # whether it needs the closed loops, linear around the reference's last point

    @abstractmethod
    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        """Note every mistake of the schedule for slots of these coordinates."""

    @abstractmethod
    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """Return the longest stretch of each slot that is certain before a run, s, by coordinate."""

    def sequence(self, problem: Problem) -> SlotSpans:  # noqa: ARG002
        """Return one period as (coordinate, duration in s); empty where the schedule is not periodic."""
        return ()

    @abstractmethod
    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Return Block (time, error, state, reference, _slot_before, _age_before, _admissible, warm_up) -> slot, its number."""


@dataclass(frozen=True)
class FixedSchedule(Schedule):
    """Slots at given times.

    Args:
        spans: (coordinate, start, end) in s, without gaps from 0 s to the end of the run.
    """

    spans: Sequence[tuple[str, float, float]]

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        unit = problem.time_unit
        wrong = [span for span in self.spans if not _is_span(span)]
        for span in wrong:
            mistakes.add(f"FixedSchedule: {span!r} is no span; expected (coordinate, start, end) with times in {unit}")
        if wrong:
            return
        _check_visits("FixedSchedule", [c for c, _, _ in self.spans], names, mistakes)
        at, half = 0.0, 0.5 * problem.period
        for name, start, end in self._ordered():
            where = f"FixedSchedule: '{name}' from {start:g} to {end:g} {unit}"
            if end - start < problem.period * (1 - 1e-9):
                mistakes.add(
                    f"{where} is shorter than one control cycle of {problem.period:g} {unit}; let it end later"
                )
            if start < at - half:
                mistakes.add(f"{where} overlaps the slot before it, which ends at {at:g} {unit}; let it start there")
            elif start > at + half:
                mistakes.add(
                    f"FixedSchedule: no slot from {at:g} to {start:g} {unit}; let '{name}' start at {at:g} {unit}"
                )
            at = max(at, end)
        end = problem.duration
        if at > end + half:
            mistakes.add(
                f"FixedSchedule: the last slot ends at {at:g} {unit}, after the run's {end:g} {unit}; let it end there"
            )
        elif at < end - half:
            mistakes.add(f"FixedSchedule: no slot from {at:g} {unit} to the end of the run at {end:g} {unit}; add one")

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        del problem
        longest, before, stretch = dict.fromkeys(names, 0.0), "", 0.0
        for name, start, end in self._ordered():
            stretch = end - start + (stretch if name == before else 0.0)
            longest[name], before = max(longest[name], stretch), name
        return longest

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Return Block time -> slot."""
        starts = [(name, start / problem.period) for name, start, _ in self._ordered()]
        return _timed(problem, channels, starts)

    def _ordered(self) -> list[tuple[str, float, float]]:
        return sorted(self.spans, key=lambda span: nominal(span[1]))


@dataclass(frozen=True, eq=False)
class Periodic(Schedule):
    """Slots in turn, again and again.

    Args:
        durations: coordinate -> s, in the order of the slots.
    """

    durations: Mapping[str, float]

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        _check_visits("Periodic", self.durations, names, mistakes)
        for name, duration in self.durations.items():
            check_stretch(f"Periodic: duration of '{name}'", duration, problem, mistakes)

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        if len(self.durations) == 1:
            return dict.fromkeys(self.durations, problem.duration)
        return {n: self.durations.get(n, 0.0) for n in names}

    def sequence(self, problem: Problem) -> SlotSpans:
        return tuple((n, round(d / problem.period) * problem.period) for n, d in self.durations.items())

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Return Block time -> slot."""
        starts, at = [], 0.0
        for name, duration in self.durations.items():
            starts.append((name, at))
            at += rounded(duration / problem.period)
        return _timed(problem, channels, starts, at)


def _is_span(span: object) -> bool:
    return isinstance(span, tuple | list) and len(span) == 3 and all(finite_number(t) for t in span[1:])


def _check_visits(owner: str, visited: Iterable[str], names: Sequence[str], mistakes: Mistakes) -> None:
    """Note coordinates that have no slot; where there are none, slots that are never active."""
    coordinates = list(visited)
    mistakes.unknown(f"{owner}: coordinate", coordinates, names)
    for name in names:
        if name not in coordinates and set(coordinates) <= set(names):
            mistakes.add(f"{owner}: slot '{name}' is never active; give it time, or leave the slot out")


def check_stretch(what: str, value: float, problem: Problem, mistakes: Mistakes) -> None:
    """Note a length of time that is no positive number or shorter than one control cycle."""
    unit = problem.time_unit
    if not (finite_number(value) and value > 0):
        mistakes.add(f"{what} must be a positive number, in {unit}, got {value!r}")
    elif value < problem.period * (1 - 1e-9):
        mistakes.add(f"{what} is {value:g} {unit}, shorter than one control cycle of {problem.period:g} {unit}")


def _timed(
    problem: Problem, channels: Sequence[Channel], starts: Sequence[tuple[str, float]], cycles: float | None = None
) -> Block:
    """Block time -> slot from the cycles in which slots start, repeated after `cycles` where that is a number."""
    numbers = {c.slot.coordinate: c.number for c in channels}
    order = [numbers[name] for name, _ in starts]

    def step(s: Signals) -> dict[str, Expression]:
        cycle = ca.floor(s.time / problem.period + 0.5)
        phase = cycle if cycles is None else ca.fmod(cycle, expressed(cycles, cycle))
        slot = ca.SX(order[0])
        for before, number, (_, start) in zip(order, order[1:], starts[1:], strict=False):
            slot += (number - before) * (phase > start - 0.5)
        return {"slot": slot}

    return Block("schedule", Layout((time_signal(problem.plant),)), Layout((scalar("slot"),)), step)


_STILL = 1e-6  # size of a derivative, relative to its terms, that counts as zero
_SAMPLES = 100  # instants at which the reference is looked at


@dataclass(frozen=True, eq=False)
class Mode:
    """One slot near the set-point, with n states of the plant."""

    plant: Plant  # that moves
    generator: np.ndarray  # A of z' = A z, or of the divided differences of a map, shape (n + 2, n + 2)
    command: np.ndarray  # row k with u - u* = k z, shape (n + 2,)
    own: np.ndarray  # row of y^(r) in x - x*, shape (n,)
    gain: float  # b, derivative of y^(r) with respect to the input
    law: np.ndarray  # row of y^(r),Des in z without the offset, shape (n + 2,)
    first_integral: np.ndarray  # row of the integral at the start of the slot in x - x*, shape (n,)
    blends: bool  # whether a switch leaves an offset
    integrates: bool  # whether the law has an integral

    @property
    def eigenvalues(self) -> np.ndarray:
        """Eigenvalues of the motion within the slot, or of its divided differences, 1/s, without the decay of the offset."""
        size = self.generator.shape[0] - (1 if self.integrates else 2)
        return np.linalg.eigvals(self.generator[:size, :size])

    @property
    def rate(self) -> float:
        """Largest rate of growth, 1/s: the speed with which the slot's zero dynamics diverge."""
        return float(growth_of(self.plant)(self.eigenvalues).max()) if np.isfinite(self.generator).all() else math.inf

    def over(self, time: float) -> np.ndarray:
        """Return the matrix from z to z after that time within the slot."""
        return step_of(self.plant, self.generator, time)

    def start(self, before: Mode, held: float = 0.0) -> np.ndarray:
        """Return the matrix from z at the end of the slot `before` to z at the start of this one; the command is continuous.

        `held`: time before its end at which z is taken, since the last command was given then: the cycle of a map.
        """
        n = self.own.size
        matrix, ended = np.zeros((n + 2, n + 2)), before.over(held)[:n]
        matrix[:n] = ended
        matrix[n] = self.first_integral @ ended
        if self.blends:
            realised = self.own @ ended + self.gain * before.command
            matrix[n + 1] = realised - self.law @ matrix
        return matrix

    def goes_on(self) -> np.ndarray:
        """Return the matrix from z to z where no switch happens: the integral stays, and there is no offset."""
        return np.diag([*np.ones(self.own.size), float(self.integrates), 0.0])


def linear_modes(
    problem: Problem, channels: Sequence[Channel], parameters: np.ndarray, blend: float
) -> tuple[list[Mode], str]:
    """Return the modes at the reference's last point; where there are none an empty list and the reason.

    `parameters`: of the plant, shape (np,). `blend`: time constant of the offset at a switch, s; 0 leaves the offset out.
    """
    other = [c.slot.coordinate for c in channels if c.slot.tracking.feedback(c.chain.order) is None]
    if other:
        return [], f"the tracking law of slot '{other[0]}' is no feedback with constant gains, such as Exponential"
    set_point = _set_point(problem, parameters)
    if isinstance(set_point, str):
        return [], set_point
    return [_mode(problem, one, parameters, blend, *set_point) for one in channels], ""


def _set_point(problem: Problem, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray] | str:
    plant = problem.plant
    if not _rests(problem):
        return f"the reference still moves at its end, t = {problem.duration:g} {problem.time_unit}"
    states = reference_states(problem, _SAMPLES)
    state = states[:, -1]
    known = x, u, p = plant.symbols()
    rate = plant.equations.rate(*known)
    sizes = ca.mtimes(ca.fabs(ca.jacobian(rate, ca.vertcat(*known))), ca.fabs(ca.vertcat(*known)))
    function = ca.Function("fpirhc_rate", [x, u, p], [rate, *map(ca.densify, (ca.jacobian(rate, u), sizes))])
    free, gain, _ = (np.asarray(v.full()) for v in function(state, np.zeros(u.numel()), parameters))
    command = np.linalg.lstsq(gain, -free, rcond=None)[0].ravel()
    residual, _, terms = (np.abs(np.asarray(v.full()).ravel()) for v in function(state, command, parameters))
    slow = np.abs(states).max(axis=1) / problem.duration
    if not (residual <= _STILL * (np.nan_to_num(terms) + slow)).all():
        return f"the reference's last point is no equilibrium: no input brings |x'| below {residual.max():.3g}"
    return state, command


def _rests(problem: Problem) -> bool:
    """Whether every derivative at the reference's end is small beside its largest value and the quantity's size over the run."""
    plant, times = problem.plant, np.linspace(0.0, problem.duration, _SAMPLES)
    function = problem.reference.function(plant).map(_SAMPLES)
    motion, response = (np.abs(np.asarray(v.full())) for v in function(times[None, :]))
    elements = dict(zip(plant.output.elements, motion, strict=True))
    highest = {name + "'" * order: row for (name, order), row in zip(plant.chains.items(), response, strict=True)}
    return all(
        row[-1] <= _STILL * (row.max() + elements[e.rstrip("'")].max() / problem.duration ** e.count("'"))
        for e, row in {**elements, **highest}.items()
        if "'" in e
    )


def _mode(
    problem: Problem, one: Channel, parameters: np.ndarray, blend: float, state: np.ndarray, command: np.ndarray
) -> Mode:
    plant, law = problem.plant, one.slot.tracking.feedback(one.chain.order)
    assert law is not None
    x, u, p = plant.symbols()
    rate, calm = plant.equations.rate(x, u, p), ca.SX.zeros(len(plant.names))
    acting_input = u[plant.input.elements.index(one.chain.input)]
    realised = one.chain.response(x, u, p, calm)
    derivatives = [
        (rate, x),
        (rate, acting_input),
        (one.chain.states(x, p), x),
        (realised, x),
        (realised, acting_input),
    ]
    function = ca.Function("fpirhc_linear", [x, u, p], [ca.densify(ca.jacobian(f, v)) for f, v in derivatives])
    a, b, chain, own, gain = (np.asarray(v.full()) for v in function(state, command, parameters))
    n, gains = a.shape[0], np.array(law.gains)
    integral, proportional = (gains[0], gains[1:]) if law.integral else (0.0, gains)
    with np.errstate(all="ignore"):  # rates beyond all numbers: the mode says so
        feedback = proportional @ chain
    desired = np.concatenate([-feedback, [integral, 0.0]])
    offset = np.eye(n + 2)[n + 1] if blend > 0 else np.zeros(n + 2)
    generator = np.zeros((n + 2, n + 2))
    generator[:n, :n] = a
    with np.errstate(all="ignore"):
        through = (desired + offset - np.concatenate([own.ravel(), [0, 0]])) / gain.item()
        generator[:n] += b @ through[None, :]
    if law.integral:
        generator[n, :n] = -chain[0]
    if blend > 0:
        generator[n + 1, n + 1] = rate_of_decay(plant, blend)
    first = feedback / integral if law.integral and law.bumpless else np.zeros(n)
    return Mode(plant, generator, through, own.ravel(), gain.item(), desired, first, blend > 0, law.integral)


_NEVER = -FINITE  # score of a slot that may not be chosen
Scores = Callable[[Signals], list[Expression]]


@dataclass(frozen=True, eq=False)
class ByError(Schedule):
    """The coordinate with the largest weighted error w|e| is next.

    A slot that has lasted `dwell` ends in the first cycle in which w|e| of some admissible slot is more than (1 + hysteresis) times
    that of the active slot.

    Args:
        weights: coordinate -> weight, in 1 / unit of the coordinate.
        dwell: shortest duration of a slot, s.
        hysteresis: by how much another weighted error must be larger, relative.
    """

    weights: Mapping[str, float]
    dwell: float
    hysteresis: float = 0.1

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        mistakes.unknown("ByError: weight of coordinate", self.weights, names)
        misspelt = set(self.weights) - set(names)
        for name in names:
            weight = self.weights.get(name)
            if weight is None and misspelt:
                continue
            if not (_is_number(weight) and weight > 0):
                mistakes.add(f"ByError: the weight of '{name}' must be a positive number, got {weight!r}")
        _check_choice("ByError", self.dwell, self.hysteresis, problem, mistakes)

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        del problem
        return dict.fromkeys(names, self.dwell)

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Return Block (error, ...) -> slot."""
        weights = [self.weights[c.slot.coordinate] for c in channels]
        places = [problem.judged_names.index(c.slot.coordinate) for c in channels]

        def score(s: Signals) -> list[Expression]:
            return [w * ca.fabs(s.error[k]) for w, k in zip(weights, places, strict=True)]

        return _chosen(problem, channels, score, self.dwell, self.hysteresis)


@dataclass(frozen=True, eq=False)
class ByLookAhead(Schedule):
    """The slot whose linearised closed loop brings the state closest to the reference within one dwell is next.

        argmin_j V(e^(A_j T) (x - x^N)),    V(x) = sum w x^2,   T = dwell

    A slot that has lasted `dwell` ends in the first cycle in which V of the active slot exceeds (1 + hysteresis) times V of some
    admissible slot. The matrices A_j are the model's at the reference's last point.

    Args:
        weights: state -> weight of its square.
        dwell: shortest duration of a slot, s.
        hysteresis: by how much the active slot's V must exceed the best one's, relative.
    """

    foresees: ClassVar[bool] = True

    weights: Mapping[str, float]
    dwell: float
    hysteresis: float = 0.1

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        del names
        mistakes.unknown("ByLookAhead: weight of state", self.weights, problem.plant.state.elements)
        weights = list(self.weights.values())
        if not all(_is_number(w) and w >= 0 for w in weights) or not any(weights):
            mistakes.add(f"ByLookAhead: weights must be numbers of at least 0, one of them positive, got {weights}")
        _check_choice("ByLookAhead", self.dwell, self.hysteresis, problem, mistakes)

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        del problem
        return dict.fromkeys(names, self.dwell)

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Return Block (state, reference, ...) -> slot."""
        modes, _ = linear_modes(problem, channels, problem.plant.approximate, 0.0)
        n = problem.plant.state.size
        column = lambda values: np.ravel(settled(self, values)._forms(problem, modes))  # noqa: E731
        row = following("look_ahead", live_numbers(self), column)
        own = nominal(self)._forms(problem, modes)

        def score(s: Signals) -> list[Expression]:
            away = s.state - reference_state(problem.plant, s.reference)
            forms = own if row is None else _matrices(getattr(s, row.signal.name), n)
            return [-ca.bilin(ca.SX(form), away, away) for form in forms]

        block = _chosen(problem, channels, score, self.dwell, self.hysteresis)
        return block if row is None else replace(block, reads=block.reads + row.reads, derived=row.derived)

    def _forms(self, problem: Problem, modes: Sequence[Mode]) -> list[np.ndarray]:
        """The matrix of V one dwell later, as a form of the distance now, for every slot."""
        n = problem.plant.state.size
        weight = np.diag([self.weights.get(e, 0.0) for e in problem.plant.state.elements])
        transitions = [(m.over(self.dwell) @ m.start(m))[:n, :n] for m in modes]
        return [phi.T @ weight @ phi for phi in transitions]


def _matrices(column: Expression, n: int) -> list[Expression]:
    """The matrices in a column, which holds their rows one after the other."""
    return [ca.reshape(one, n, n).T for one in ca.vertsplit(column, n * n)]


def _check_choice(owner: str, dwell: float, hysteresis: float, problem: Problem, mistakes: Mistakes) -> None:
    check_stretch(f"{owner}: dwell", dwell, problem, mistakes)
    if not (_is_number(hysteresis) and hysteresis >= 0):
        mistakes.add(f"{owner}: hysteresis must be a number of at least 0, got {hysteresis!r}")


def _is_number(value: object) -> TypeGuard[float]:
    return finite_number(value)


def _chosen(problem: Problem, channels: Sequence[Channel], score: Scores, dwell: float, hysteresis: float) -> Block:
    """Block -> slot: it stays for the dwell and then changes to an admissible slot whose score is clearly larger."""
    plant = problem.plant
    names = tuple(c.slot.coordinate for c in channels)
    reads = (
        error_signal(problem, "error"),
        plant.state,
        like(plant.output, "reference"),
        scalar("_slot_before"),
        scalar("_age_before"),
        scalar("warm_up"),
        Signal("_admissible", names),
    )
    shortest = rounded(dwell / problem.period)

    def step(s: Signals) -> dict[str, Expression]:
        scores = [ca.if_else(s._admissible[k] > 0.5, v, _NEVER) for k, v in enumerate(score(s))]
        best, slot, active = scores[0], ca.SX(0), scores[0]
        for k, value in enumerate(scores[1:], 1):
            slot, best = ca.if_else(value > best, k, slot), ca.fmax(best, value)
            active = ca.if_else(s._slot_before > k - 0.5, value, active)
        clear = best - active > hysteresis * ca.fmin(ca.fabs(best), ca.fabs(active))
        free = ca.logic_and(s._age_before + 1 > shortest - 0.5, clear)
        return {"slot": ca.if_else(ca.logic_or(s.warm_up < 0.5, free), slot, s._slot_before)}

    return Block("schedule", Layout(reads), Layout((scalar("slot"),)), step)
