"""What a saturating map needs beside its gain: the slowest iteration of the plain form, the basin of its step, and two-cycles.

The derivations stand in docs/theory-robust.md. With N poles of the tracking law at -Lambda the plain form is stable for
a lambda >= sin(theta)^N tan(theta) T Lambda, theta = (N - 1) pi / (2 N): 0, 1/2, 9/8, 1.759, 2.395 for N = 1 ... 5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidShape, InvalidValue

_SPARE, _SPARE_OF_TWO_POLES = 1.25, 1.5
_REAL = 1e-6  # imaginary part of an eigenvalue, relative, below which it is real
_NONE = 1e-12  # share of the largest eigenvalue below which an eigenvalue counts as zero
_DECADES = (1e-6, 1e6)  # range of amplitudes that is searched, as multiples of the typical size
_POINTS = 400
_BISECTIONS = 50


def slowest_iteration(poles: int) -> float:
    """Return the least a lambda / (T Lambda) with which the plain form is stable; 0 for one pole.

    Args:
        poles: N of the tracking law: n + 1 for relative order n with the integral, n without it.
    """
    if poles < 1:
        raise InvalidValue(f"slowest_iteration(poles={poles!r}): expected at least one pole of the tracking law")
    angle = (poles - 1) * math.pi / (2 * poles)
    return math.sin(angle) ** poles * math.tan(angle)


def least_product(poles: int, rate: float, period: float) -> float:
    """Return the least a lambda with which the plain form is stable around a tracking law of that rate.

    It holds to first order in rate x period.

    Args:
        poles: N of the tracking law, as in `slowest_iteration`.
        rate: Lambda of the tracking law, 1/s.
        period: T of the control cycle, s.

    Raises:
        InvalidValue: fewer than one pole, a rate or a period that is not positive.
    """
    if not (0 < rate < math.inf and 0 < period < math.inf):
        raise InvalidValue(f"least_product(rate={rate!r}, period={period!r}): expected positive numbers, 1/s and s")
    return slowest_iteration(poles) * rate * period


def basin_of_plain_form(
    largest_step: float, poles: int, rate: float, period: float, *, eigenvalue: float = 1.0
) -> float:
    """Return the largest |f - d| from which the plain form comes back; infinite for one pole or an unbounded step.

    Args:
        largest_step: of the map per cycle, in units of the response.
        poles: N of the tracking law, as in `slowest_iteration`.
        rate: Lambda of the tracking law, 1/s.
        period: T of the control cycle, s.
        eigenvalue: lambda of the response Jacobian.

    Raises:
        InvalidValue: a step, rate, period or eigenvalue that is not positive, or fewer than one pole.
    """
    if not (largest_step > 0 and 0 < eigenvalue < math.inf):
        raise InvalidValue(
            f"basin_of_plain_form(largest_step={largest_step!r}, eigenvalue={eigenvalue!r}): expected positive numbers"
        )
    slowest = least_product(poles, rate, period)
    return largest_step * eigenvalue / slowest if slowest else math.inf


def step_for_basin(largest_error: float, poles: int, rate: float, period: float, *, eigenvalue: float = 1.0) -> float:
    """Return the step per cycle that a map needs to come back from an error of that size, with its spare factor.

    Args:
        largest_error: |f - d|, in units of the response.
        poles: N of the tracking law, as in `slowest_iteration`.
        rate: Lambda of the tracking law, 1/s.
        period: T of the control cycle, s.
        eigenvalue: lambda of the response Jacobian.

    Raises:
        InvalidValue: a negative error, a rate, period or eigenvalue that is not positive, or fewer than one pole.
    """
    if not (largest_error >= 0 and 0 < eigenvalue < math.inf):
        raise InvalidValue(
            f"step_for_basin(largest_error={largest_error!r}, eigenvalue={eigenvalue!r}): expected an error of at least 0 and a "
            "positive eigenvalue"
        )
    spare = _SPARE_OF_TWO_POLES if poles == 2 else _SPARE
    return spare * least_product(poles, rate, period) * largest_error / eigenvalue


def two_cycle_limit(low: np.ndarray, high: np.ndarray, gains: Sequence[float]) -> float:
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
