"""A linear loop with long delay lines: what comes out of one is what went in, many cycles later.

    det M(z) = 0,    M(z) = z I - F0 - sum_j f_j e_j' z^(-l_j)

are its poles without the lines' entries, counted by the argument principle. Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NoReturn

import numpy as np

from fpirhc.errors import NoAnswer
from fpirhc.simulation.linearise.linear_loop import NEUTRAL, LinearLoop

_TOGETHER = 4096  # matrices at once
_PER_TURN = 8  # points of a circle for a turn of all lines together
_LEAST = 512  # points of half a circle
_SAFE = math.pi / 2  # change of log det M between two points, from which there are more between them and beside them
_HALVINGS = 30
_EDGE = 1e-8  # relative error of a radius
_SHOWN = 1e-6  # of a judged error, in a mode of length 1
_DEEPEST = 200.0  # -log of what the longest line makes of a decaying mode, beyond which numbers end


@dataclass(frozen=True, eq=False)
class Late:
    """What an entry of z does some cycles later.

    Args:
        place: of the entry.
        cycles: later.
        dynamics: f (n,).
        arriving: what it adds to the commands (nu,).
    """

    place: int
    cycles: int
    dynamics: np.ndarray
    arriving: np.ndarray


@dataclass(frozen=True, eq=False)
class LateLoop(LinearLoop):
    """A loop of one cycle, whose matrices are those of what acts at once; build it with `Linearisation.at`."""

    late: tuple[Late, ...] = ()  # what acts later

    @property
    def longest(self) -> int:
        """Cycles of the longest delay."""
        return max((one.cycles for one in self.late), default=0)

    @property
    def _waiting(self) -> int:
        """Cycles of all lines together, which det M turns by at most while z turns once."""
        return sum({one.place: one.cycles for one in sorted(self.late, key=lambda one: one.cycles)}.values())

    @cached_property
    def radius(self) -> float:
        """The factor per cycle of the slowest or fastest growing mode, by halving; neutral modes as in `LinearLoop.radius`."""
        hidden = self._neutral
        lower, upper = -_DEEPEST / max(self.longest, 1), 0.0 if not hidden else math.log1p(NEUTRAL)
        if self._outside(lower) <= hidden:
            return math.exp(lower)
        while self._outside(upper):
            lower, upper = upper, 2 * upper + 1e-3
            hidden = 0  # they lie inside
        while upper - lower > _EDGE:
            middle = (lower + upper) / 2
            lower, upper = (middle, upper) if self._outside(middle) > hidden else (lower, middle)
        return math.exp(upper)

    @property
    def _neutral(self) -> int:
        """Number of modes that stay as they are, M(1) V = 0, and that no judged error shows, E V = 0.

        Where no error shows any of them, multiple ones count as often as det M turns along a circle around z = 1.
        """
        [matrix] = self._matrices(np.ones(1)).real
        _, sizes, rows = np.linalg.svd(matrix)
        still = rows[sizes <= NEUTRAL * max(float(sizes[0]), 1.0)]
        shown = int(np.linalg.matrix_rank(still @ self.errors.T, tol=_SHOWN)) if len(self.errors) else len(still)
        if shown or not len(still):
            return len(still) - shown
        signs, _ = self._determinants(1 + 10 * NEUTRAL * np.exp(2j * math.pi * np.linspace(0.0, 1.0, _LEAST + 1)))
        return round(float(np.angle(signs[1:] / signs[:-1]).sum()) / (2 * math.pi))

    def opened(self, place: int) -> Callable[[np.ndarray], np.ndarray]:
        [one] = self.cycles
        entry = one.entry[:, place]

        def response(frequencies: np.ndarray) -> np.ndarray:
            values = np.empty(len(frequencies), dtype=complex)
            for some in _parts(len(frequencies)):
                points = np.exp(1j * frequencies[some] * self.period)
                command = np.repeat(one.arriving[place].astype(complex)[None], len(points), axis=0)
                for later in self.late:
                    command[:, later.place] += later.arriving[place] * points**-later.cycles
                matrices = self._matrices(points) + entry[:, None] * command[:, None, :]
                moved = np.linalg.solve(matrices, np.broadcast_to(entry[:, None], (len(points), len(entry), 1)))
                values[some] = -(command * moved[:, :, 0]).sum(axis=1)
            return values

        return response

    def delayed(self, inputs: Sequence[int], cycles: int) -> LinearLoop:
        if cycles < 0:
            self._refuse()
        [one], some = self.cycles, list(inputs)
        acts, sent = one.entry[:, some], np.zeros(len(one.arriving))

        def waiting(place: int, later: int, command: np.ndarray) -> Late:
            """The commands (some,) of an entry, which arrive some cycles later."""
            arriving = sent.copy()
            arriving[some] = command
            return Late(place, later, acts @ command, arriving)

        at_once = [
            replace(k, dynamics=k.dynamics - acts @ k.arriving[some], arriving=_without(k.arriving, some))
            for k in self.late
        ]
        queued = [waiting(k.place, k.cycles + cycles, k.arriving[some]) for k in self.late]
        queued += [
            waiting(place, cycles, command) for place, command in enumerate(one.arriving[some].T) if command.any()
        ]
        cycle = replace(one, dynamics=one.dynamics - acts @ one.arriving[some], arriving=_without(one.arriving, some))
        return replace(self, cycles=(cycle,), late=(*at_once, *queued))

    @property
    def poles(self) -> np.ndarray:
        self._refuse()

    @property
    def hidden(self) -> np.ndarray:
        return np.zeros(0, dtype=bool)

    @property
    def dynamics(self) -> np.ndarray:
        self._refuse()

    def with_noise(self, feedthrough: Sequence[np.ndarray], correlation: np.ndarray) -> LinearLoop:  # noqa: ARG002
        self._refuse()

    def carried(self, deviation: np.ndarray, cycles: int) -> tuple[np.ndarray, np.ndarray]:  # noqa: ARG002
        self._refuse()

    def mixed(self, other: LinearLoop, share: float) -> LinearLoop:  # noqa: ARG002
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise NoAnswer(f"a loop with a delay line of {self.longest} cycles is not written out")

    def _matrices(self, points: np.ndarray) -> np.ndarray:
        """M(z) at some points."""
        [one] = self.cycles
        matrices = points[:, None, None] * np.eye(len(one.dynamics)) - one.dynamics
        for later in self.late:
            matrices[:, :, later.place] -= later.dynamics * (points**-later.cycles)[:, None]
        return matrices

    def _determinants(self, points: np.ndarray) -> np.ndarray:
        """The sign det M / |det M|, and log |det M|, at some points, shape (2, number)."""
        return np.hstack([np.array(np.linalg.slogdet(self._matrices(points[some]))) for some in _parts(len(points))])

    def _outside(self, logarithm: float) -> int:
        """Number of poles on the circle with this logarithm of its radius, or outside: n less the turns of det M along it."""
        signs, count = self._half(logarithm), len(self.cycles[0].dynamics)
        if not signs.all():
            return count + 1  # some pole is on it
        turns = float(np.angle(signs[1:] / signs[:-1]).sum()) / math.pi  # of half a circle, the other one is its mirror
        return count - round(turns)

    def _half(self, logarithm: float) -> np.ndarray:
        """Signs of det M at points of the upper half of a circle, close enough to count turns; a zero ends it.

        Several poles together turn det M by a whole turn within a short way, which two signs do not show. Its size does, there or
        in the next interval.
        """
        angles = np.linspace(0.0, math.pi, max(_LEAST, _PER_TURN * self._waiting // 2) + 1)
        found = self._determinants(np.exp(logarithm + 1j * angles))
        for _ in range(_HALVINGS):
            if not found[0].all():
                break
            moved = np.hypot(np.angle(found[0, 1:] / found[0, :-1]), np.diff(found[1].real))
            moved = np.pad(moved, 1)
            wide = np.flatnonzero(np.maximum(np.maximum(moved[:-2], moved[2:]), moved[1:-1]) > _SAFE)
            if not wide.size:
                break
            between = (angles[wide] + angles[wide + 1]) / 2
            more = self._determinants(np.exp(logarithm + 1j * between))
            angles, found = np.insert(angles, wide + 1, between), np.insert(found, wide + 1, more, axis=1)
        return np.asarray(found[0])


def _without(arriving: np.ndarray, some: list[int]) -> np.ndarray:
    """What arrives without some of the commands."""
    rest = arriving.copy()
    rest[some] = 0.0
    return rest


def _parts(count: int) -> list[slice]:
    return [slice(k, k + _TOGETHER) for k in range(0, count, _TOGETHER)]
