"""Eigenvalues of the response Jacobian on the reference and near it, and the limit of gain times eigenvalue.

The deformation works from the first request, r = d, to the fixed point r*, and the state begins at the start of the problem. J is
therefore evaluated at requests from d to r* and a little beyond both, and at states that are displaced by the first tracking error.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from fpirhc.contraction.delayed import leaking_limit
from fpirhc.contraction.spectrum import Spectrum, response_jacobian
from fpirhc.controllers.check import product_limit
from fpirhc.deformation.base import Deformation, Iteration
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid, each
from fpirhc.symbolic.expression import kind
from fpirhc.task.problem import Problem

_SHARES = (-0.25, 0.5, 1.0, 1.25)  # of the way from the nominal response to the request that the plant needs
_SAMPLES = 2000


def eigenvalues_near(
    grid: ReviewGrid, believed: np.ndarray, draws: np.ndarray, iteration: Iteration, *, near: bool
) -> np.ndarray:
    """Return eigenvalues of J W, shape (samples, n); samples that are not finite are left out.

    Args:
        grid: points of the reference.
        believed: parameters of the model, shape (np,).
        draws: the first draws of the grid, shape (draws, np); as many are used as the number of samples allows.
        iteration: of the deformation, whose W it is.
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
    transposed = finite.reshape(-1, n, n)  # has the same eigenvalues
    matrices = transposed if iteration.weights is None else iteration.weighted(transposed.transpose(0, 2, 1))
    return np.linalg.eigvals(matrices).reshape(-1, n)


def spectrum_near(
    grid: ReviewGrid, believed: np.ndarray, draws: np.ndarray, iteration: Iteration, *, near: bool
) -> Spectrum:
    """Return `eigenvalues_near` as a spectrum.

    Raises:
        InvalidValue: none is finite.
    """
    return Spectrum(eigenvalues_near(grid, believed, draws, iteration, near=near))


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


_LIMIT = 2.0  # of gain times eigenvalue without delay


def dead_cycles(problem: Problem) -> float:
    """Longest dead time between a request and its response, in control cycles beyond the one that every loop has."""
    return max(channel_cycles(problem))


def channel_cycles(problem: Problem) -> tuple[float, ...]:
    """Dead time between each input and the measured response, in control cycles beyond the one that every loop has."""
    times = problem.dead_time
    return tuple((times.inputs.get(n, 0.0) + times.measurement) / problem.period for n in problem.plant.inputs)


def largest_product(problem: Problem, deformation: Deformation, eigenvalues: np.ndarray | None = None) -> float:
    """Return the limit of effective gain times eigenvalue: 2, or less under a dead time or behind an estimator or a filter.

    It is that of the iteration by itself (`leaking_limit`), the smallest of all channels. Input k belongs to controlled coordinate
    k where the dead times differ. The model-referenced form has another limit for every eigenvalue.

    Args:
        problem: the problem.
        deformation: the deformation.
        eigenvalues: of the response Jacobian, for the model-referenced form; their smallest and largest sizes count.
    """
    pairing = deformation.iteration.pairing
    averaged = pairing is not None and pairing.uncertainty > 0
    behind = None if averaged else product_limit(problem, deformation)
    if behind is not None:
        return behind
    late = channel_cycles(problem)
    if not any(late) and not (pairing and pairing.cycles):
        return _LIMIT
    own = (pairing.channels or (pairing.cycles or 0.0,) * len(late)) if pairing else (0.0,) * len(late)
    sizes = np.array([1.0]) if eigenvalues is None else np.abs(eigenvalues)
    extremes = {float(sizes.min()), float(sizes.max())}
    return min(_limit(deformation, *pair, size) for pair in set(zip(late, own, strict=True)) for size in extremes)


def _limit(deformation: Deformation, late: float, own: float, size: float) -> float:
    """Limit of gain times an eigenvalue of this size, of one channel."""
    pairing = deformation.iteration.pairing
    whole = math.floor(late + 1e-9)
    share = max(late - whole, 0.0)
    weights = np.append(np.zeros(whole), [1 - share, share])
    limit = leaking_limit(
        weights,
        cycles=own,
        leak=deformation.iteration.leak,
        pole=deformation.iteration.error_pole,
        eigenvalue=size,
        referenced=deformation.mirror.referenced,
        width=pairing.uncertainty if pairing else 0,
    )
    return min(limit * size, _LIMIT)
