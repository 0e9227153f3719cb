"""Derivatives of one step of a closed loop at a point of its run, along as many directions as its motion reaches.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import NoAnswer, NotSupported
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator

_STEP = 2.0**-19  # of a deviation, in scales: above rounding, and below what makes a line search choose another share
_NEW = 1e-4  # what is new in a direction of length 1, below which it is left out
_ROUNDING = 1e-9  # derivative in scales
LARGEST = 400  # directions

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
            sizes = np.sqrt(np.maximum((deviations**2).sum(axis=0), (w**2).sum(axis=0)))
            moved, traces = np.zeros_like(deviations), np.zeros((self.loop.trace.size, w.shape[1]))
            some = np.flatnonzero(sizes)
            h = _STEP / sizes[some, None]
            by_memory, by_input = h * scales * deviations.T[some], h * w.T[some]
            ahead, behind = self._each(memory + by_memory, by_input), self._each(memory - by_memory, -by_input)
            moved[:, some] = ((ahead[0] - behind[0]) / (2 * h * scales)).T
            traces[:, some] = ((ahead[1] - behind[1]) / (2 * h)).T
            _finite(moved)
            return np.where(np.abs(moved) > _ROUNDING * sizes, moved, 0.0), traces

        return move

    def _each(self, memories: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The next memories and the traces of some memories and inputs, by rows."""
        memories_next, traces = np.empty_like(memories), np.empty((len(memories), self.loop.trace.size))
        for k in range(len(memories)):
            self.into(memories[k], w[k], memories_next[k], traces[k])
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
    count, fixed = len(ways), ~free
    parts = [_Part(some, free.size, inputs, None if begun is None else begun[k]) for k, some in enumerate(ways)]
    waiting = [list(np.eye(free.size)[list(always)]) for _ in ways]  # of each cycle, what is to be looked at
    if begun is None:
        waiting[0].extend(np.eye(free.size)[first])

    def passed(place: int, moved: np.ndarray) -> None:
        moved[fixed] = 0.0
        waiting[(place + 1) % count].extend(moved.T)

    for k, part in enumerate(parts):
        for kicked, _ in part.kicked if begun is None else part.kicked[:-1]:
            passed(k, kicked / (np.linalg.norm(kicked * free[:, None], axis=0) + 1e-300))
        for moved in part.caught_up():
            passed(k, moved)
    while any(waiting):
        for place, part in enumerate(parts):
            some, waiting[place] = waiting[place], []
            passed(place, part.moved(part.joined(some)))
    return [part.directions for part in parts]


class _Part:
    """The directions of one cycle while they are sought."""

    def __init__(self, ways: Sequence[Way], size: int, inputs: int, begun: Directions | None) -> None:
        self.ways, self.count, self._inputs, self._begun = ways, 0, inputs, begun
        others = ways if begun is None else ways[:-1]
        self.kicked = [_kicked(way, size, inputs) for way in others] + ([] if begun is None else begun.kicked)
        self.basis = np.zeros((size, 0))
        self._images: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in ways]

    def caught_up(self) -> list[np.ndarray]:
        """Take over the directions that are known of the last way; return what the other ways make of them."""
        if self._begun is None:
            return []
        self._append(self._begun.basis)
        self._images[-1].append((self._begun.moved[0], self._begun.traces[0]))
        calm = np.zeros((self._inputs, self.count))
        for way, known in zip(self.ways[:-1], self._images, strict=False):
            known.append(way(self._begun.basis, calm))
        return [known[0][0].copy() for known in self._images[:-1]]

    def joined(self, some: Sequence[np.ndarray]) -> np.ndarray:
        """Add what is new in some deviations (n,); return these directions (n, m)."""
        before = self.count
        for one in _new(some, self.basis[:, :before]) if len(some) > 1 else some:
            basis = self.basis[:, : self.count]
            for _ in range(2):  # the second time for the rounding of the first
                one = one - basis @ (one @ basis)
            length = math.sqrt(one @ one)
            if length > _NEW:
                if self.count >= LARGEST:
                    raise NotSupported(f"more than {LARGEST} entries of its memory move")
                self._append((one / length)[:, None])
        return self.basis[:, before : self.count].copy()

    def moved(self, directions: np.ndarray) -> np.ndarray:
        """Return what every way makes of directions (n, m) that were added, direction by direction."""
        if not directions.size:
            return directions
        for way, known in zip(self.ways, self._images, strict=True):
            known.append(way(directions, np.zeros((self._inputs, directions.shape[1]))))
        return np.stack([known[-1][0] for known in self._images], axis=2).reshape(len(directions), -1)

    def _append(self, directions: np.ndarray) -> None:
        rows, more = directions.shape
        if self.count + more > self.basis.shape[1]:
            wider = np.zeros((rows, 2 * (self.count + more) + 32), order="F")
            wider[:, : self.count] = self.basis[:, : self.count]
            self.basis = wider
        self.basis[:, self.count : self.count + more] = directions
        self.count += more

    @property
    def directions(self) -> Directions:
        """Those that were found, and what each way makes of them."""
        moved, traces = ([np.hstack([one[k] for one in known]) for known in self._images] for k in (0, 1))
        return Directions(self.basis[:, : self.count].copy(), moved, traces, self.kicked)


def _new(some: Sequence[np.ndarray], basis: np.ndarray) -> Sequence[np.ndarray]:
    """Those deviations (n,) of which orthonormal directions (n, m) leave more than rounding, looked at together."""
    deviations = np.array(some)
    rests = deviations - (deviations @ basis) @ basis.T
    return deviations[np.linalg.norm(rests, axis=1) > _NEW]


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
