"""Cycles without a sample, as the blocks of a step know them.

Theory: docs/theory-plants.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.symbolic.expression import total
from fpirhc.symbolic.layout import Expression, scalar

LONG = 1e15  # the gap that is not bridged; shares of it are one
GAP, SETTLING = scalar("gap"), scalar("settling")
GAPS = (GAP, SETTLING)


def is_long(gap: Expression) -> Expression:
    """Return whether the gap is longer than what is bridged."""
    return gap > LONG / 2


def shares(gap: Expression, count: int, degree: int = 1) -> list[Expression]:
    """Return the shares w_1 ... w_count of the newest value in values that are 1 ... count cycles old."""
    result = []
    for i in range(1, count + 1):
        share = ca.fmax(0, gap + 1 - i) / (gap + 1)
        for j in range(2, degree + 1):
            share *= (gap + j - i) / (gap + j)
        result.append(share)
    return result


def straightened(queue: Expression, newest: Expression, gap: Expression) -> Expression:
    """Return a queue of columns, newest first, whose newest one was repeated over the gap, on the straight line to now."""
    size = newest.numel()
    entries = ca.vertsplit(queue)
    line = shares(gap, len(entries) // size)
    return ca.vertcat(*(e + line[k // size] * (newest[k % size] - e) for k, e in enumerate(entries)))


def ahead(count: int, degree: int) -> np.ndarray:
    """Return the weights of values 1 ... count cycles old, newest first, in the polynomial through them at this cycle.

    It is the polynomial of that degree, or of the highest one that the values determine, by least squares.
    """
    powers = np.vander(-np.arange(1.0, count + 1) / count, min(degree, count - 1) + 1, increasing=True)
    return np.asarray(np.linalg.pinv(powers)[0])


def continued(weights: np.ndarray, values: Sequence[Expression]) -> Expression:
    """Return the value of the polynomial at this cycle; see `ahead`."""
    return total(float(w) * v for w, v in zip(weights, values, strict=True))
