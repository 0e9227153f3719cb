"""What cannot be observed along a motion.

Theory: docs/theory-estimation.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

_NOTHING = 1e-9  # share of a matrix below which a part of it counts as zero


def unobservable(slopes: Sequence[np.ndarray], shown: Sequence[np.ndarray]) -> np.ndarray:
    """Return an orthonormal basis of the errors that never show, shape (nx, number).

    Args:
        slopes: A_i, each (nx, nx), in states of size one.
        shown: C_i, each (number, nx), in states of size one.
    """
    basis = _kernel(np.vstack([_rows_of_size_one(c) for c in shown]))
    motions = [a / max(np.abs(a).max(), np.finfo(float).tiny) for a in slopes]
    while basis.shape[1]:
        leaving = np.vstack([a @ basis - basis @ (basis.T @ (a @ basis)) for a in motions])
        staying = _kernel(leaving)
        if staying.shape[1] == basis.shape[1]:
            break
        basis = basis @ staying
    return basis


def members(basis: np.ndarray) -> list[int]:
    """Return the places of the states that have a part in these errors."""
    return [k for k, row in enumerate(basis) if np.abs(row).max(initial=0.0) > 1e-6]


def slowest(
    slopes: Sequence[np.ndarray], basis: np.ndarray, growth: Callable[[np.ndarray], np.ndarray] = np.real
) -> float:
    """Return the largest real part of the poles with which these errors move, in 1 / unit of time; negative: all decay.

    Args:
        growth: of poles; of a map's divided differences it is not the real part (`fpirhc.plant.maps.decay_rates`).
    """
    if not basis.shape[1]:
        return -np.inf
    dual = np.linalg.pinv(basis)
    return max(float(growth(np.linalg.eigvals(dual @ a @ basis)).max()) for a in slopes)


def _kernel(matrix: np.ndarray) -> np.ndarray:
    _, values, rows = np.linalg.svd(matrix, full_matrices=True)
    rank = int((values > _NOTHING).sum())
    return np.asarray(rows[rank:].T)


def _rows_of_size_one(matrix: np.ndarray) -> np.ndarray:
    """The matrix with rows of size one at most; rows of zero stay zero."""
    largest = np.abs(matrix).max(axis=1, keepdims=True)
    return np.asarray(matrix / np.where(largest > 0, largest, 1.0))
