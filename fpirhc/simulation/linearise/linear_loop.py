"""A linear loop, z+ = F z + G w, v = C z, e = E z: its poles, and the neutral modes among them that no judged quantity shows.

z are deviations of what the loop remembers, w is added to the plant's inputs, v are the commands that arrive there, and e are the
judged errors. A loop that repeats itself after n cycles only has n such matrices; its modes are those of their product.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np

NEUTRAL = 1e-6  # distance of |pole| from 1, where a mode neither decays nor grows
# States, from which a triangle and the import of scipy.linalg are quicker than a solution for every frequency.
_MANY = 60
_DOUBLINGS, _OVER = 16, 1e-12  # of a sum over periods, and what is left of a state where it is over
_SHOWN = 1e-6  # share of a judged error in an eigenvector, in scales


@dataclass(frozen=True, eq=False)
class LinearCycle:
    """One cycle: F (n, n), G (n, nu), C (nu, n), and X (nx, n), the states of the plant that moves."""

    dynamics: np.ndarray
    entry: np.ndarray
    arriving: np.ndarray
    state: np.ndarray

    def mixed(self, other: LinearCycle, share: float) -> LinearCycle:
        """Return one + share (one - other)."""
        own, before = ((one.dynamics, one.entry, one.arriving) for one in (self, other))
        dynamics, entry, arriving = (one + share * (one - low) for one, low in zip(own, before, strict=True))
        return LinearCycle(dynamics, entry, arriving, self.state)


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """The cycles of one period of a linear loop."""

    cycles: tuple[LinearCycle, ...]  # as many as the loop needs to repeat itself; one for plans in every cycle
    errors: np.ndarray  # E (judged, n); no rows: every mode counts
    placed: np.ndarray  # Z (n, nx), the deviation z of a deviation of the plant's state alone
    period: float  # of the control cycle

    @cached_property
    def dynamics(self) -> np.ndarray:
        """F of a whole period, the product of those of its cycles."""
        return np.asarray(reduce(lambda done, one: one.dynamics @ done, self.cycles[1:], self.cycles[0].dynamics))

    @cached_property
    def poles(self) -> np.ndarray:
        """Eigenvalues of a whole period."""
        return np.asarray(np.linalg.eigvals(self.dynamics))

    @property
    def radius(self) -> float:
        """The factor per cycle of the slowest or fastest growing mode; neutral modes that no judged error shows are left out."""
        return float(np.abs(self.poles[~self.hidden]).max(initial=0.0) ** (1 / len(self.cycles)))

    @cached_property
    def hidden(self) -> np.ndarray:
        """Which poles are no fault of the loop: of modes that neither plant nor command show, and neutral ones that no error shows.

        The first live in the controller's memory alone, such as a covariance that forgets. A neutral mode, |pole| = 1, neither
        decays nor grows; where E V = 0 for its eigenvector V, it is the amount of a drug that has left the body, or the heat of a
        jacket whose change alone is weighed. A double one, such as the time that cars spend in a queue that stays, splits by the
        square root of rounding, so the mean of poles that lie together is what counts.
        """
        count = len(self.cycles)
        near = np.abs(self.poles[:, None] - self.poles) < 10 * NEUTRAL * count
        means = np.abs(near @ self.poles / near.sum(axis=1))
        lasting = means > 1 - NEUTRAL * count
        if not len(self.errors) or not lasting.any():
            return np.zeros(len(self.poles), dtype=bool)
        values, vectors = np.linalg.eig(self.dynamics)  # z is in scales already
        sizes = np.abs(vectors).max(axis=0)
        by_error, by_any = (_seen(rows, vectors) / sizes for rows in (self.errors, self._everything))
        near = [np.abs(values - pole) < 10 * NEUTRAL * count for pole in self.poles]
        neutral = lasting & (means < 1 + NEUTRAL * count)
        no_error, nothing = (
            np.array([share[one].max(initial=0.0) < _SHOWN for one in near]) for share in (by_error, by_any)
        )
        return (neutral & no_error) | (lasting & nothing)

    @property
    def longest(self) -> int:
        """Cycles of the longest delay line that is not written out; see `LateLoop`."""
        return 0

    def opened(self, place: int) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function frequencies -> L_i of the loop opened at one command.

        It is found from the matrices, because polynomials of so many states lose all digits.
        """
        [one] = self.cycles
        g, c = one.entry[:, place], one.arriving[place]
        if len(self.dynamics) > _MANY:
            return self._by_schur(g, c)
        closed, unit = self.dynamics - np.outer(g, c), np.eye(len(self.dynamics))

        def response(frequencies: np.ndarray) -> np.ndarray:
            points = np.exp(1j * frequencies * self.period)
            right = np.broadcast_to(g[:, None], (len(points), len(g), 1))  # columns in NumPy 1 too
            return np.asarray(-(np.linalg.solve(points[:, None, None] * unit - closed, right)[:, :, 0] @ c))

        return response

    def _by_schur(self, g: np.ndarray, c: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """The same for many states, which are brought into a triangle once."""
        from scipy.linalg import schur  # it takes longer to import than a problem to load

        form, turn = schur(self.dynamics - np.outer(g, c), output="complex")
        left, right = c @ turn, turn.conj().T @ g

        def response(frequencies: np.ndarray) -> np.ndarray:
            points = np.exp(1j * frequencies * self.period)
            states = np.zeros((len(form), len(frequencies)), dtype=complex)
            for k in reversed(range(len(form))):
                states[k] = (right[k] + form[k, k + 1 :] @ states[k + 1 :]) / (points - form[k, k])
            return np.asarray(-left @ states)

        return response

    def with_noise(self, feedthrough: Sequence[np.ndarray], correlation: np.ndarray) -> LinearLoop:
        """Return the loop whose w is a noise n+ = c n + w, of which z remembers the present value.

        Args:
            feedthrough: of every cycle, what n adds to v at once, shape (nu, nw).
            correlation: c, shape (nw,); zero for white noise.
        """
        width, cycles = len(correlation), []
        for one, at_once in zip(self.cycles, feedthrough, strict=True):
            dynamics = np.block(
                [[one.dynamics, one.entry], [np.zeros((width, one.dynamics.shape[1])), np.diag(correlation)]]
            )
            entry = np.vstack([np.zeros_like(one.entry), np.eye(width)])
            state = np.pad(one.state, ((0, 0), (0, width)))
            cycles.append(LinearCycle(dynamics, entry, np.hstack([one.arriving, at_once]), state))
        errors, placed = np.pad(self.errors, ((0, 0), (0, width))), np.pad(self.placed, ((0, width), (0, 0)))
        return LinearLoop(tuple(cycles), errors, placed, self.period)

    def delayed(self, inputs: Sequence[int], cycles: int) -> LinearLoop:
        """Return the loop some of whose commands arrive later by so many cycles, or earlier where the number is negative.

        Later they wait in a queue behind the one of the loop. Earlier they are what will arrive then, C F^m z, which is known as
        long as the loop delays them by m cycles.
        """
        count, some = len(self.cycles), list(inputs)
        if cycles < 0:
            ahead = [self._arriving_after(k, -cycles)[some] for k in range(count)]
            return replace(self, cycles=tuple(_fed(one, some, v) for one, v in zip(self.cycles, ahead, strict=True)))
        width = cycles * len(some)
        return replace(
            self,
            cycles=tuple(_queued(one, some, width) for one in self.cycles),
            errors=np.pad(self.errors, ((0, 0), (0, width))),
            placed=np.pad(self.placed, ((0, width), (0, 0))),
        )

    def _arriving_after(self, first: int, cycles: int) -> np.ndarray:
        """Commands (nu, n) that arrive some cycles after one of the period, of z at that one."""
        count, moved = len(self.cycles), np.eye(self.cycles[first].dynamics.shape[1])
        for k in range(first, first + cycles):
            moved = self.cycles[k % count].dynamics @ moved
        return self.cycles[(first + cycles) % count].arriving @ moved

    def carried(self, deviation: np.ndarray, cycles: int) -> tuple[np.ndarray, np.ndarray]:
        """Return states (cycles, nx, ...) and arriving commands (cycles, nu, ...) after a deviation z (n, ...) at the start."""
        z, states, commands = deviation, [], []
        for k in range(cycles):
            one = self.cycles[k % len(self.cycles)]
            states.append(one.state @ z)
            commands.append(one.arriving @ z)
            z = one.dynamics @ z
        return np.array(states), np.array(commands)

    def spread(self, covariance: np.ndarray) -> np.ndarray:
        """Return the covariance (n, n) of z at the first cycle where w is white noise with a covariance (nw, nw) in every cycle.

        It is P = F P F' + Q of a loop that converges, where Q is what the noise of the cycles of a period adds up to. The sum
        ends after 65 536 periods at the latest, so that a neutral mode is as wide as after a long run.
        """
        total, moved = np.zeros_like(self.dynamics, shape=2 * self.cycles[0].dynamics.shape[1:]), self.dynamics
        for one in self.cycles:
            total = one.dynamics @ total @ one.dynamics.T + one.entry @ covariance @ one.entry.T
        with np.errstate(over="ignore", invalid="ignore"):  # a loop that grows has no bound
            for _ in range(_DOUBLINGS):
                total, moved = total + moved @ total @ moved.T, moved @ moved
                if not np.abs(moved).max(initial=0.0) > _OVER:
                    break  # what is added may be small and grow later, so the motion is asked and not the sum
        return np.asarray(total)

    def steps(self, covariance: np.ndarray) -> np.ndarray:
        """Return the rms (nu,) of v_k+1 - v_k = (C F - C) z_k + C G w_k over a period, where w is white noise with a covariance.

        The covariance has the shape (nw, nw). What grows is infinite.
        """
        spread, squares = self.spread(covariance), np.zeros(len(self.cycles[0].arriving))
        with np.errstate(over="ignore", invalid="ignore"):
            for one, later in zip(self.cycles, (*self.cycles[1:], self.cycles[0]), strict=True):
                moved = later.arriving @ one.dynamics - one.arriving
                parts = (moved, spread), (later.arriving @ one.entry, covariance)
                squares += sum(np.einsum("ij,jk,ik->i", m, s, m) for m, s in parts)
                spread = one.dynamics @ spread @ one.dynamics.T + one.entry @ covariance @ one.entry.T
        return np.sqrt(np.where(np.isfinite(squares), np.maximum(squares, 0.0), np.inf) / len(self.cycles))

    def mixed(self, other: LinearLoop, share: float) -> LinearLoop:
        """Return one + share (one - other) of loops in the same coordinates, whose matrices a number moves in proportion."""
        cycles = (one.mixed(before, share) for one, before in zip(self.cycles, other.cycles, strict=True))
        return replace(self, cycles=tuple(cycles))

    @property
    def _shown(self) -> np.ndarray:
        """The states of a whole period, one cycle after the other (count nx, n), that z at its first cycle leads to."""
        rows, moved = [], np.eye(len(self.dynamics))
        for one in self.cycles:
            rows.append(one.state @ moved)
            moved = one.dynamics @ moved
        return np.vstack(rows)

    @property
    def _everything(self) -> np.ndarray:
        """What plant, errors and commands show of the deviation at the first cycle, by rows."""
        rows, moved = [self.errors, self.cycles[0].state], np.eye(len(self.cycles[0].dynamics.T))
        for one in self.cycles:
            rows.append(one.arriving @ moved)
            moved = one.dynamics @ moved
        return np.vstack(rows)


def _fed(one: LinearCycle, some: list[int], arriving: np.ndarray) -> LinearCycle:
    """The cycle with other commands (some, n) in place of those that arrive."""
    changed = one.arriving.copy()
    changed[some] = arriving
    return replace(one, dynamics=one.dynamics + one.entry @ (changed - one.arriving), arriving=changed)


def _queued(one: LinearCycle, some: list[int], width: int) -> LinearCycle:
    """The cycle with a queue of that width between some of the commands and the plant."""
    after, size = one.dynamics.shape
    wider = replace(
        one,
        dynamics=np.zeros((after + width, size + width)),
        entry=np.pad(one.entry, ((0, width), (0, 0))),
        arriving=np.pad(one.arriving, ((0, 0), (0, width))),
        state=np.pad(one.state, ((0, 0), (0, width))),
    )
    wider.dynamics[:after, :size] = one.dynamics
    wider.dynamics[after : after + len(some), :size] = one.arriving[some]
    wider.dynamics[after + len(some) :, size : size + width - len(some)] = np.eye(width - len(some))
    return _fed(wider, some, np.eye(size + width)[size + width - len(some) :])


def _seen(rows: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Largest share of a row, of length 1, in each vector."""
    # Squares of a loop that runs away overflow.
    rows = rows / np.maximum(np.abs(rows).max(axis=1, keepdims=True), 1e-300)
    lengths = np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    return np.asarray(np.abs((rows / lengths) @ vectors).max(axis=0))
