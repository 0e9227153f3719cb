"""The exact condition for a bounded two-cycle of the whole loop behind a saturating map, and the size of its errors.

Open the linear loop at the step s of the map: h = -L(z) s, where L contains the tracking law, the feedback of the plan, delays and
filters. The map is radial and odd, s = -sigma(|h|) h with the secant sigma. In a two-cycle the mean step is zero, because the map
sums its steps. So h alternates between X and -X, L acts at z = -1 alone, and harmonic balance is exact. A two-cycle exists if and
only if

    sigma(|X|) = 1 / mu      for some |X| and a positive real eigenvalue mu of -L(-1) (h = mu times the negative step).

With the effective gain a in place of sigma the closed loop is z+ = (F0 + a F1) z, and -1 is an eigenvalue of it when
a = 1 / mu, so mu are the positive real eigenvalues of -(I + F0)^-1 F1.

So the smallest 1 / mu is a limit of `secant_gain()`. Where the secant rises to a maximum there are two amplitudes: the smaller one
is a threshold, and a run ends at the larger one.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.contraction.spectrum import Array
from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidShape, InvalidValue

_REAL = 1e-6  # imaginary part of an eigenvalue, relative, below which it is real
_NONE = 1e-12  # share of the largest eigenvalue below which an eigenvalue counts as zero
_DECADES = (1e-6, 1e6)  # range of amplitudes that is searched, as multiples of the typical size
_POINTS = 400
_BISECTIONS = 50


def two_cycle_limit(low: Array, high: Array, gains: Sequence[float]) -> float:
    """Return the gain from which on a two-cycle exists; infinite where no gain leads to one.

    A secant gain beyond it, at any size of the error, leads to a bounded two-cycle. Below it there is no two-cycle.

    Args:
        low: matrix of the closed loop over one cycle with the first effective gain, shape (m, m).
        high: the same with the second effective gain.
        gains: the two effective gains, different and of one sign.

    Raises:
        InvalidShape: matrices of different shapes.
        InvalidValue: two equal gains, or of different signs.
    """
    first, second = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    if first.shape != second.shape or first.ndim != 2 or first.shape[0] != first.shape[1]:
        raise InvalidShape(f"loops of shape {first.shape} and {second.shape}: expected two square matrices of one size")
    if len(gains) != 2 or gains[0] == gains[1] or gains[0] * gains[1] <= 0:
        raise InvalidValue(f"gains={gains!r}: expected two different effective gains of one sign")
    per_gain = (second - first) / (gains[1] - gains[0])
    without = first - gains[0] * per_gain
    inverse = -np.linalg.solve(np.eye(len(first)) + without, per_gain)
    values = np.linalg.eigvals(inverse) * np.sign(gains[0])
    size = float(np.abs(values).max())
    real = values.real[(np.abs(values.imag) <= _REAL * np.abs(values)) & (values.real > _NONE * size)]
    return float(1 / real.max()) if real.size else float("inf")


def two_cycle_amplitudes(deformation: Deformation, limit: float, *, size: float) -> tuple[float, ...]:
    """Return every |h| at which the map's secant is the limit, smallest first; empty where there is no two-cycle.

    Args:
        deformation: a map without memory.
        limit: from `two_cycle_limit`.
        size: typical size of errors, in units of the response; amplitudes from 1e-6 to 1e6 times this size are searched.

    Raises:
        InvalidValue: a map with memory, a limit or a size that is not positive.
    """
    if deformation.memory(("q",)).size:
        raise InvalidValue(f"{deformation}: expected a map without memory; give the innermost one")
    if not (limit > 0 and size > 0):
        raise InvalidValue(
            f"two_cycle_amplitudes(limit={limit!r}, size={size!r}): expected a positive limit and a positive size of errors"
        )
    h = ca.SX.sym("h")
    secant = ca.Function("secant", [h], [ca.fabs(deformation.step(ca.SX(0), h, ca.SX(0), {})[0] / h)])

    grid = size * np.geomspace(*_DECADES, _POINTS)
    above = np.asarray(secant(grid[None, :]).full()).ravel() > limit
    amplitudes = []
    for k in np.flatnonzero(above[1:] != above[:-1]):
        low, high = grid[k], grid[k + 1]
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            same = (float(secant(middle)) > limit) == above[k]
            low, high = (middle, high) if same else (low, middle)
        amplitudes.append(float(0.5 * (low + high)))
    return tuple(amplitudes)
