"""Derivatives of one step of a closed loop at a point of its run, along as many directions as its motion reaches.

A scalar graph is differentiated. One with a plan, a solver or a table in it is evaluated on both sides of the point,

    J d = (step(z + h S d) - step(z - h S d)) / (2 h),        S = diag(scales),

because a solver outside has no derivatives, and those of a plan's graph take longer to build than all evaluations.

What a plan remembers for its next start are hundreds of entries that hardly move the loop. So directions are sought that the loop's
own motion reaches: beginning with the plant's states and the inputs, each one is moved by a cycle, and what is new in the result is
the next direction, until nothing is (Arnoldi's iteration).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.symbolic.block import Composite
from fpirhc.symbolic.evaluate import Evaluator

_STEP = 2.0**-19  # of a deviation, in scales: above rounding, and below what makes a line search choose another share
_NEW = 1e-4  # what is new in a direction of length 1, below which it is left out
_ROUNDING = 1e-9  # derivative in scales
_LARGEST = 400  # directions

Way: TypeAlias = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Step:
    """One step of a loop whose first read are the disturbances of all inputs; it works in one thread only."""

    def __init__(self, loop: Composite) -> None:
        """Bind the Function of the loop."""
        self.loop = loop
        self.scalar = bool(loop.function.is_a("SXFunction"))
        self._evaluator = Evaluator(loop.function)
        self._slopes: Evaluator | None = None

    def __call__(self, memory: np.ndarray, w: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the next memory and the trace; w is added to the plant's inputs."""
        self._evaluator.arguments[0][:] = memory
        self._evaluator.arguments[1][:] = w
        self._evaluator.evaluate()
        return self._evaluator.results[0].copy(), self._evaluator.results[1].copy()

    def way(self, memory: np.ndarray, scales: np.ndarray) -> Way:
        """Return the function (deviation in scales, w) -> (next deviation in scales, deviation of the trace) at a point."""
        if not self.scalar:
            return self._evaluated(memory, scales)
        if self._slopes is None:
            self._slopes = Evaluator(_derivative(self.loop.function))
        size, nu = memory.size, self._evaluator.arguments[1].size
        slopes = self._slopes(memory, np.zeros(nu))
        if not all(np.isfinite(m).all() for m in slopes):
            raise NotSupported("the loop has no finite slope at a point of its run")
        by_memory, by_input = (m.reshape(columns, -1).T for m, columns in zip(slopes, (size, nu), strict=True))

        def move(deviation: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            both = by_memory @ (scales * deviation) + by_input @ w
            return both[:size] / scales, both[size:]

        return move

    def _evaluated(self, memory: np.ndarray, scales: np.ndarray) -> Way:
        def move(deviation: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            size = float(max(np.linalg.norm(deviation), np.linalg.norm(w)))
            if size == 0:
                return np.zeros(memory.size), np.zeros(self.loop.trace.size)
            h = _STEP / size
            ahead, behind = (self(memory + s * h * scales * deviation, s * h * w) for s in (1, -1))
            ways = [(a - b) / (2 * h) for a, b in zip(ahead, behind, strict=True)]
            moved = ways[0] / scales
            return np.where(np.abs(moved) > _ROUNDING * size, moved, 0.0), ways[1]

        return move


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions of one cycle, and what each way makes of them.

    Args:
        basis: orthonormal directions (n, m) at its beginning, in scales.
        moved: by way, the next deviations (n, m).
        traces: by way, the deviations of the trace (columns, m).
    """

    basis: np.ndarray
    moved: list[np.ndarray]
    traces: list[np.ndarray]


def along(ways: Sequence[Way], basis: np.ndarray, inputs: int) -> Directions:
    """Return given directions (n, m) of a cycle, moved."""
    images = [[way(one, np.zeros(inputs)) for one in basis.T] for way in ways]
    return _collected(basis, images)


def reached(ways: Sequence[Sequence[Way]], free: np.ndarray, first: np.ndarray, inputs: int) -> list[Directions]:
    """Return directions at every cycle of a period that the motion from some first ones does not leave.

    Args:
        ways: of the cycles of the period, one or several each.
        free: which entries may deviate, (n,).
        first: places of the plant's state.
        inputs: number of inputs.

    Raises:
        NotSupported: more directions than a loop should need.
    """
    still, calm, count = np.zeros(free.size), np.zeros(inputs), len(ways)
    waiting = [(0, np.where(np.arange(free.size) == k, 1.0, 0.0)) for k in first]
    for k, some in enumerate(ways):
        moved = [way(still, one)[0] * free for way in some for one in np.eye(inputs)]
        waiting += [((k + 1) % count, one / (np.linalg.norm(one) or 1.0)) for one in moved]
    bases = [np.zeros((0, free.size))] * count
    images: list[list[list[tuple[np.ndarray, np.ndarray]]]] = [[[] for _ in some] for some in ways]
    while waiting:
        place, one = waiting.pop(0)
        basis = bases[place]
        for _ in range(2):  # the second time for the rounding of the first
            one = one - basis.T @ (basis @ one)
        length = float(np.linalg.norm(one))
        if length <= _NEW:
            continue
        if len(basis) >= _LARGEST:
            raise NotSupported(f"the loop moves in more than {_LARGEST} directions")
        bases[place] = np.vstack([basis, one / length])
        for way, known in zip(ways[place], images[place], strict=True):
            known.append(way(one / length, calm))
            waiting.append(((place + 1) % count, known[-1][0] * free))
    return [_collected(basis.T, known) for basis, known in zip(bases, images, strict=True)]


def _collected(basis: np.ndarray, images: Sequence[Sequence[tuple[np.ndarray, np.ndarray]]]) -> Directions:
    moved, traces = ([np.column_stack([one[k] for one in known]) for known in images] for k in (0, 1))
    return Directions(basis, moved, traces)


def _derivative(function: ca.Function) -> ca.Function:
    """Function (memory, w) -> slopes of (next memory, trace) by each."""
    z, w = (ca.SX.sym(name, *function.size_in(k)) for k, name in enumerate(("z", "w")))
    rest = [ca.DM.zeros(*function.size_in(k)) for k in range(2, function.n_in())]
    results = ca.vertcat(*function(z, w, *rest))
    return ca.Function("fpirhc_loop_slopes", [z, w], [ca.densify(ca.jacobian(results, v)) for v in (z, w)])
