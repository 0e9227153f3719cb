"""Neutral modes that nobody judges: an integral that nothing reads, or inputs that may drift without an effect.

A mode with |pole| = 1 neither decays nor grows. Where the judged coordinates do not show it, C V = 0 for its eigenvector V, it
is no fault of the loop: the amount of a drug that has left the body, or the heat of a jacket whose change alone is weighed.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

NEUTRAL = 1e-6  # distance of |pole| from 1
_SHOWN = 1e-6  # share of a judged coordinate in an eigenvector, in balanced units


def hidden_modes(dynamics: np.ndarray, poles: np.ndarray, judged: np.ndarray | None) -> np.ndarray:
    """Return which modes are neutral and shown by no judged coordinate, shape (n,).

    Args:
        dynamics: F of z+ = F z, shape (n, n).
        poles: its eigenvalues, shape (n,).
        judged: places of the judged coordinates in z; None: every mode counts.
    """
    neutral = np.abs(np.abs(poles) - 1) < NEUTRAL
    if judged is None or not neutral.any():
        return np.zeros(len(poles), dtype=bool)
    balanced, _ = scipy.linalg.matrix_balance(dynamics, permute=False)
    values, vectors = np.linalg.eig(balanced)
    shares = np.abs(vectors[judged]).max(axis=0) / np.abs(vectors).max(axis=0)
    shown = [shares[np.abs(values - pole) < 10 * NEUTRAL].max(initial=0.0) >= _SHOWN for pole in poles]
    return neutral & ~np.array(shown)
