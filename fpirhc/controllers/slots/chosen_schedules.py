"""Schedules that choose the next slot by the state.

    ByError        at the end of a slot, the coordinate with the largest weighted error
    ByLookAhead    at the end of a slot, the slot whose linearised closed loop brings the state closest in one dwell

Both choose only among admissible slots, those whose gain d y^(r)/du is large enough.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

import casadi as ca
import numpy as np
import scipy.linalg

from fpirhc.controllers.base import error_signal, like
from fpirhc.controllers.slots.schedules import Mode, Schedule, check_stretch, linear_modes
from fpirhc.controllers.slots.slot import Channel
from fpirhc.errors import Mistakes, NotSupported
from fpirhc.fields.kinds import finite_number
from fpirhc.horizon.nominal import reference_state
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import FINITE, Signals
from fpirhc.symbolic.following import following
from fpirhc.symbolic.functions import rounded
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar
from fpirhc.symbolic.live import live_numbers, nominal, settled
from fpirhc.task.problem import Problem

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
        """Note unknown or missing weights, and values out of range."""
        mistakes.unknown("ByError: weight of coordinate", self.weights, names)
        for name in names:
            weight = self.weights.get(name)
            if not (_is_number(weight) and weight > 0):
                mistakes.add(f"ByError: the weight of '{name}' must be a positive number, got {weight!r}")
        _check_choice("ByError", self.dwell, self.hysteresis, problem, mistakes)

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """Return the shortest duration of a slot."""
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

    weights: Mapping[str, float]
    dwell: float
    hysteresis: float = 0.1

    def check(self, names: Sequence[str], problem: Problem, mistakes: Mistakes) -> None:
        """Note unknown weights, and values out of range."""
        del names
        mistakes.unknown("ByLookAhead: weight of state", self.weights, problem.plant.state.elements)
        weights = list(self.weights.values())
        if not all(_is_number(w) and w >= 0 for w in weights) or not any(weights):
            mistakes.add(f"ByLookAhead: weights must be numbers of at least 0, one of them positive, got {weights}")
        _check_choice("ByLookAhead", self.dwell, self.hysteresis, problem, mistakes)

    def dwells(self, names: Sequence[str], problem: Problem) -> Mapping[str, float]:
        """Return the shortest duration of a slot."""
        del problem
        return dict.fromkeys(names, self.dwell)

    def block(self, problem: Problem, channels: Sequence[Channel]) -> Block:
        """Return Block (state, reference, ...) -> slot.

        Raises:
            NotSupported: the closed loops cannot be linearised at the reference's last point.
        """
        modes, reason = linear_modes(problem, channels, problem.plant.approximate, 0.0)
        if reason:
            raise NotSupported(f"ByLookAhead: {reason}; use ByError")
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
        transitions = [(scipy.linalg.expm(m.generator * self.dwell) @ m.start(m))[:n, :n] for m in modes]
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
