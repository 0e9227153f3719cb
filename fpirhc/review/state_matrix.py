"""The state's matrices from those of the responses."""

from __future__ import annotations

import numpy as np

from fpirhc.plant.plant import Plant


def state_matrices(plant: Plant, rows: np.ndarray, gains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A (nx, nx) and B (nx, nu) of x' = A x + B u from those of the responses, (n, nx) and (n, nu)."""
    nx, nu = plant.state.size, len(plant.inputs)
    a, b = np.zeros((nx, nx)), np.zeros((nx, nu))
    for k, element in enumerate(plant.state.elements):
        higher = element + "'"
        if higher in plant.state.elements:
            a[k, plant.state.elements.index(higher)] = 1.0
        else:
            place = plant.names.index(element.rstrip("'"))
            a[k], b[k] = rows[place], gains[place]
    return a, b
