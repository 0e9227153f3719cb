"""Eigenvalues of the response Jacobian on the reference and near it.

The deformation works from the first request, r = d, to the fixed point r*, and the state begins at the start of the problem. J is
therefore evaluated at requests from d to r* and a little beyond both, and at states that are displaced by the first tracking error.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.contraction.spectrum import Spectrum, response_jacobian
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid, each
from fpirhc.symbolic.expression import kind

_SHARES = (-0.25, 0.5, 1.0, 1.25)  # of the way from the nominal response to the request that the plant needs
_SAMPLES = 2000


def eigenvalues_near(grid: ReviewGrid, believed: np.ndarray, draws: np.ndarray, *, near: bool) -> np.ndarray:
    """Return eigenvalues of J, shape (samples, n); samples that are not finite are left out.

    Args:
        grid: points of the reference.
        believed: parameters of the model, shape (np,).
        draws: the first draws of the grid, shape (draws, np); as many are used as the number of samples allows.
        near: whether to sample near the reference too, and not only on it at r*.
    """
    states, requests = _near(grid, believed) if near else (grid.states, grid.requests(believed))
    count = max(1, min(len(draws), _SAMPLES // len(states)))
    places = np.unique(np.linspace(0, len(draws) - 1, count).astype(int))
    rows = draws[places]
    m, n = requests.shape
    points = np.tile(states, (len(rows), 1)) if near else grid.drawn_states[places].reshape(len(rows) * m, -1)
    known = (np.repeat(rows, m, axis=0), np.tile(believed, (m * len(rows), 1)))
    jacobians = each(stacked_jacobian(grid.problem.plant), points, np.tile(requests, (len(rows), 1)), *known)
    finite = jacobians[np.isfinite(jacobians).all(axis=1)]
    # The transposed Jacobian has the same eigenvalues.
    return np.linalg.eigvals(finite.reshape(-1, n, n)).reshape(-1, n)


def spectrum_near(grid: ReviewGrid, believed: np.ndarray, draws: np.ndarray, *, near: bool) -> Spectrum:
    """Return `eigenvalues_near` as a spectrum.

    Raises:
        InvalidValue: none is finite.
    """
    return Spectrum(eigenvalues_near(grid, believed, draws, near=near))


def _near(grid: ReviewGrid, believed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first = grid.problem.start_state - grid.states[0]
    wanted, needed = grid.responses, grid.requests(believed)
    states, requests = [], []
    for sign in (-1.0, 0.0, 1.0):
        for share in _SHARES:
            states.append(grid.states + sign * first)
            requests.append(wanted + share * (needed - wanted))
    return np.vstack(states), np.vstack(requests)


def stacked_jacobian(plant: Plant) -> ca.Function:
    """Return the response Jacobian as one column."""
    function = response_jacobian(plant)
    matrix = kind(plant.equations.inverse_opaque)
    symbols = [matrix.sym(f"v{k}", function.size1_in(k)) for k in range(function.n_in())]
    return ca.Function("fpirhc_stacked_jacobian", symbols, [ca.vec(function(*symbols))])
