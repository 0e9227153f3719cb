"""Derivatives of one step of a closed loop at a point of its run, along as many directions as its motion reaches.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import NoAnswer, NotSupported
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.expression import FINITE, kind

_STEP = 2.0**-19  # of a deviation, in scales: above rounding, and below what makes a line search choose another share
_NEW = 1e-4  # what is new in a direction of length 1, below which it is left out
_ROUNDING = 1e-9  # derivative in scales
LARGEST = 400  # directions
CALL = 10  # cycles of a run in one call
STATE_BEFORE = "_state_before"  # in the memory: the state of the plant that moves

Way: TypeAlias = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Step:
    """One step of a loop and one of the signals w that it reads, the others at zero; it works in one thread only."""

    def __init__(self, loop: Composite, entering: str) -> None:
        """Bind the Function of the loop, and the name of w."""
        self.loop, self._entry = loop, 1 + loop.reads.names.index(entering)
        self.width = loop.reads[entering].size
        self.scalar = bool(loop.function.is_a("SXFunction"))
        self._evaluator = Evaluator(loop.function)
        self._slopes: Evaluator | None = None

    def __call__(self, memory: np.ndarray, w: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the next memory and the trace."""
        memory_next, trace = (np.empty_like(result) for result in self._evaluator.results)
        self.into(memory, w, memory_next, trace)
        return memory_next, trace

    def into(self, memory: np.ndarray, w: np.ndarray | float, memory_next: np.ndarray, trace: np.ndarray) -> None:
        """Write the next memory and the trace into two arrays."""
        self._evaluator.arguments[0][:] = memory
        self._evaluator.arguments[self._entry][:] = w
        self._evaluator.evaluate()
        memory_next[:], trace[:] = self._evaluator.results

    @cached_property
    def led(self) -> Evaluator:
        """Evaluator of `CALL` cycles: (memory, x (cycles, nx)) -> (memories, traces, states before they are put at x).

        All but the first argument are tables with a row per cycle. A state whose x is NaN moves by itself.
        """
        return Evaluator(_led(self.loop).mapaccum("fpirhc_led_run", CALL, {"base": 5}))

    def way(self, memory: np.ndarray, scales: np.ndarray) -> Way:
        """Return the function (deviations in scales, w) -> (next deviations in scales, deviations of the trace), all by columns."""
        if not self.scalar:
            return self._evaluated(memory, scales)
        if self._slopes is None:
            self._slopes = Evaluator(_derivative(self.loop.function, self._entry))
        size = memory.size
        slopes = self._slopes(memory, np.zeros(self.width))
        _finite(*slopes)
        by_memory, by_input = (m.reshape(columns, -1).T for m, columns in zip(slopes, (size, self.width), strict=True))

        def move(deviations: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            both = by_memory @ (scales[:, None] * deviations) + by_input @ w
            return both[:size] / scales[:, None], both[size:]

        return move

    def _evaluated(self, memory: np.ndarray, scales: np.ndarray) -> Way:
        def move(deviations: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rows, inputs = deviations.T, w.T
            sizes = np.sqrt(np.maximum((rows * rows).sum(axis=1), (inputs * inputs).sum(axis=1)))
            lengths = np.where(sizes > 0, sizes, 1.0)[:, None]
            h = _STEP / lengths
            by_memory, by_input = h * scales * rows, h * inputs
            ahead, behind = self._each(memory + by_memory, by_input), self._each(memory - by_memory, -by_input)
            moved = (ahead[0] - behind[0]) / (2 * h * scales)
            _finite(moved)
            moved[np.abs(moved) <= _ROUNDING * lengths] = 0.0
            return moved.T, ((ahead[1] - behind[1]) / (2 * h)).T

        return move

    def _each(self, memories: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The next memories and the traces of some memories and inputs, by rows."""
        memories_next, traces = np.empty_like(memories), np.empty((len(memories), self.loop.trace.size))
        at, entering = self._evaluator.arguments[0], self._evaluator.arguments[self._entry]
        (after, trace), evaluate, acts = self._evaluator.results, self._evaluator.evaluate, w.any()
        entering[:] = 0.0
        for k in range(len(memories)):
            at[:] = memories[k]
            if acts:
                entering[:] = w[k]
            evaluate()
            memories_next[k], traces[k] = after, trace
        return memories_next, traces


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions of one cycle, and what each way makes of them."""

    basis: np.ndarray  # orthonormal directions (n, m) at its beginning, in scales
    moved: list[np.ndarray]  # by way, the next deviations (n, m)
    traces: list[np.ndarray]  # by way, the deviations of the trace (columns, m)
    # by way, the next deviations (n, m) and the deviations of the trace (columns, m) after each w alone
    kicked: list[tuple[np.ndarray, np.ndarray]]


def along(ways: Sequence[Way], basis: np.ndarray, inputs: int) -> Directions:
    """Return given directions (n, m) of a cycle, moved."""
    images = [way(basis, np.zeros((inputs, basis.shape[1]))) for way in ways]
    kicked = [_kicked(way, len(basis), inputs) for way in ways]
    return Directions(basis, [moved for moved, _ in images], [trace for _, trace in images], kicked)


def _kicked(way: Way, size: int, inputs: int) -> tuple[np.ndarray, np.ndarray]:
    return way(np.zeros((size, inputs)), np.eye(inputs))


def reached(
    ways: Sequence[Sequence[Way]],
    free: np.ndarray,
    first: np.ndarray,
    inputs: int,
    begun: Sequence[Directions] | None = None,
    always: Sequence[int] = (),
) -> list[Directions]:
    """Return directions at every cycle of a period that the motion from some first ones does not leave.

    Args:
        free: which entries may deviate, (n,).
        first: places of the plant's state.
        begun: those of each cycle's last way alone, from which the others go on; None: none are known.
    """
    count, fixed = len(ways), np.flatnonzero(~free)
    parts = [_Part(some, free.size, inputs, None if begun is None else begun[k]) for k, some in enumerate(ways)]
    unit = np.eye(free.size)
    waiting = [[unit[list(always)]] if always else [] for _ in ways]  # of each cycle, by rows, what is to be looked at
    if begun is None:
        waiting[0].append(unit[first])

    def passed(place: int, moved: np.ndarray) -> None:
        if moved.size:
            moved[fixed] = 0.0
            waiting[(place + 1) % count].append(moved.T)

    for k, part in enumerate(parts):
        for kicked, _ in part.kicked if begun is None else part.kicked[:-1]:
            passed(k, kicked / (np.linalg.norm(kicked * free[:, None], axis=0) + 1e-300))
        for moved in part.caught_up():
            passed(k, moved)
    while any(waiting):
        for place, part in enumerate(parts):
            some, waiting[place] = waiting[place], []
            if some:
                passed(place, part.moved(part.joined(np.vstack(some))))
    return [part.directions for part in parts]


class _Part:
    """The directions of one cycle while they are sought."""

    def __init__(self, ways: Sequence[Way], size: int, inputs: int, begun: Directions | None) -> None:
        self.ways, self.count, self._inputs, self._begun = ways, 0, inputs, begun
        others = ways if begun is None else ways[:-1]
        self.kicked = [_kicked(way, size, inputs) for way in others] + ([] if begun is None else begun.kicked)
        self._rows = np.zeros((0, size))  # of which the first ones are the directions
        self._images: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in ways]

    def caught_up(self) -> list[np.ndarray]:
        """Take over the directions that are known of the last way; return what the other ways make of them."""
        if self._begun is None:
            return []
        self._append(self._begun.basis.T)
        self._images[-1].append((self._begun.moved[0], self._begun.traces[0]))
        calm = np.zeros((self._inputs, self.count))
        for way, known in zip(self.ways[:-1], self._images, strict=False):
            known.append(way(self._begun.basis, calm))
        return [known[0][0].copy() for known in self._images[:-1]]

    def joined(self, deviations: np.ndarray) -> np.ndarray:
        """Add what is new in some deviations, by rows; return these directions (n, m)."""
        before = self.count
        known = self._rows[:before]
        rests = deviations - (deviations @ known.T) @ known
        for one in rests[np.sqrt((rests * rests).sum(axis=1)) > _NEW]:
            for rows in (self._rows[before : self.count], self._rows[: self.count]):  # the second time for rounding
                one = one - (rows @ one) @ rows
            length = math.sqrt(one @ one)
            if length > _NEW:
                if self.count >= LARGEST:
                    raise NotSupported(f"more than {LARGEST} entries of its memory move")
                self._append(one[None, :] / length)
        return self._rows[before : self.count].T.copy()

    def moved(self, directions: np.ndarray) -> np.ndarray:
        """Return what every way makes of directions (n, m) that were added, direction by direction."""
        if not directions.size:
            return directions
        for way, known in zip(self.ways, self._images, strict=True):
            known.append(way(directions, np.zeros((self._inputs, directions.shape[1]))))
        return np.stack([known[-1][0] for known in self._images], axis=2).reshape(len(directions), -1)

    def _append(self, directions: np.ndarray) -> None:
        more = len(directions)
        if self.count + more > len(self._rows):
            known = self._rows[: self.count]
            self._rows = np.zeros((2 * (self.count + more) + 32, known.shape[1]))
            self._rows[: self.count] = known
        self._rows[self.count : self.count + more] = directions
        self.count += more

    @property
    def directions(self) -> Directions:
        """Those that were found, and what each way makes of them."""
        moved, traces = ([np.hstack([one[k] for one in known]) for known in self._images] for k in (0, 1))
        return Directions(self._rows[: self.count].T.copy(), moved, traces, self.kicked)


def _led(loop: Composite) -> ca.Function:
    """Function (memory, x) -> (next memory with its state at x, trace, its state before that)."""
    function, place = loop.function, loop.memory.slice(STATE_BEFORE)
    own, x = (ca.SX.sym(n, place.stop - place.start) for n in ("own", "x"))
    put = ca.Function("fpirhc_put", [own, x], [ca.if_else(ca.fabs(x) <= FINITE, x, own)])
    matrix = kind(not function.is_a("SXFunction"))
    z, x = matrix.sym("z", *function.size_in(0)), matrix.sym("x", place.stop - place.start)
    memory, trace = function.call([z, *(matrix.zeros(*function.size_in(k)) for k in range(1, function.n_in()))])
    before, own, behind = ca.vertsplit(memory, [0, place.start, place.stop, memory.numel()])
    return ca.Function("fpirhc_led", [z, x], [ca.vertcat(before, put(own, x), behind), trace, own])


def _derivative(function: ca.Function, entry: int) -> ca.Function:
    """Function (memory, w) -> slopes of (next memory, trace) by each, w being the argument with that number."""
    z, w = ca.SX.sym("z", *function.size_in(0)), ca.SX.sym("w", *function.size_in(entry))
    arguments = [z, *(ca.SX.zeros(*function.size_in(k)) for k in range(1, function.n_in()))]
    arguments[entry] = w
    results = ca.vertcat(*function(*arguments))
    return ca.Function("fpirhc_loop_slopes", [z, w], [ca.densify(ca.jacobian(results, v)) for v in (z, w)])


def _finite(*slopes: np.ndarray) -> None:
    """Raise if a slope is not finite."""
    if not all(np.isfinite(m).all() for m in slopes):
        raise NoAnswer("the loop has no finite slope at a point of its run")
