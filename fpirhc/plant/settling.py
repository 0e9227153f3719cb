"""States of a plant at rest while the others are held: the equilibrium of an actuator, a bristle, a motor behind its spring."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from fpirhc.plant.plant import Plant

_STEPS = 60  # of Newton's method
_REST = 1e-8  # largest rate of a state at rest, as a share of its rate at the first guess


def settled(
    plant: Plant, state: np.ndarray, command: np.ndarray, parameters: np.ndarray, free: Sequence[int]
) -> np.ndarray | None:
    """Return the state in which the rates of its free entries are zero; None where there is no such state.

    Newton's method from the entries of `state`. Where many values are at rest, the nearest is taken (steps of least length).

    Args:
        plant: the plant.
        state: shape (nx,); its free entries are the first guess.
        command: held input, shape (nu,).
        parameters: shape (np,).
        free: places of the entries that settle.
    """
    places = list(free)
    x, u, p = plant.symbols()
    rate = plant.equations.rate(x, u, p)[places]
    step_of = ca.Function("fpirhc_settling", [x, u, p], [rate, ca.densify(ca.jacobian(rate, x)[:, places])])
    at, largest = np.array(state, dtype=float), 0.0
    for count in range(_STEPS):
        rates, slope = (np.asarray(m.full()) for m in step_of(at, command, parameters))
        if not (np.isfinite(rates).all() and np.isfinite(slope).all()):
            return None
        size = float(np.abs(rates).max(initial=0.0))
        largest = size if count == 0 else largest
        step = np.linalg.lstsq(slope, -rates.ravel(), rcond=None)[0]
        at[places] += step
        if float(np.abs(step).max(initial=0.0)) <= 1e-12 * (1 + float(np.abs(at[places]).max(initial=0.0))):
            return at if size <= _REST * max(1.0, largest) else None
    return None
