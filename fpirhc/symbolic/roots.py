"""Roots of a few smooth equations, by Newton's method with steps of least length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

_STEPS = 60
_SMALL = 1e-10  # last step, relative


@dataclass(frozen=True, eq=False)
class Root:
    """Where Newton's method has come to rest.

    Args:
        at: the unknowns, shape (n,).
        left: largest equation before the last step, each in units of its largest slope. It is large where the method rests at a
            point that solves nothing.
        first: the same at the guess.
    """

    at: npt.NDArray[np.float64]
    left: float
    first: float


class Equations:
    """Equations r(z, data) = 0.

    Args:
        unknown: z, a column of symbols.
        known: the data, symbols.
        residual: r, expressions of both.
    """

    def __init__(self, unknown: ca.SX, known: Sequence[ca.SX], residual: ca.SX) -> None:
        slope = ca.jacobian(residual, unknown)
        both = [ca.densify(residual), ca.densify(slope)]
        self._values = ca.Function("fpirhc_equations", [unknown, *known], both)

    def root(self, guess: npt.NDArray[np.float64], *known: npt.NDArray[np.float64]) -> Root | None:
        """Return the root that the method finds from a guess; None where it does not come to rest, or meets what is no number.

        A step is the shortest of those that solve the linear equations best, z - r'(z)^+ r(z): where many points are roots it
        goes to a near one.
        """
        at, first = np.array(guess, dtype=float), None
        for _ in range(_STEPS):
            residual, slope = (np.asarray(m.full()) for m in self._values(at, *known))
            if not (np.isfinite(residual).all() and np.isfinite(slope).all()):
                return None
            sizes = np.abs(slope).max(axis=1, initial=0.0)  # rows differ by powers of the fastest rate
            sizes[sizes == 0] = 1.0
            scaled = residual.ravel() / sizes
            left = float(np.abs(scaled).max(initial=0.0))
            first = left if first is None else first
            step = np.linalg.lstsq(slope / sizes[:, None], -scaled, rcond=None)[0]
            at += step
            if np.abs(step).max(initial=0.0) <= _SMALL * (1 + np.abs(at).max(initial=0.0)):
                return Root(at, left, first)
        return None
