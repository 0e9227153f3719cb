"""A tube around the nominal run, to first order: a bound of the distance between the plant's run and the model's.

Over cycle k, w_k acts on the deviation (`prediction.ResponseErrors`). It is bounded by

    p_k = e_k - (I - a J_k) e_{k-1},        e+_k = |p_k| + |I - a J_k| |p_{k-1}| + |(I - a J_k) (I - a J_{k-1})| |p_{k-2}| + ...,

and w+_k = e+_k + |w_k - e_k|, with absolute values entry by entry, so that |e_k| <= e+_k whatever the signs of the parts p are. The
loop of plant = model without deformation has the impulse response h_j from w. With the largest h_j at some points of the reference,

    |x_k - x^_k| <= sum_j |h_j| w+_{k-1-j}.

For a tracking law with three poles at -Lambda and a constant w+ this is 4 e^-2 w+ / Lambda^2 for the coordinate.

The bound is one to first order: the response errors are those along the nominal run and not along the plant's, which matters where
the deviation is not small, and the loop is linear. Limits that clip in the run and not in the prediction are left out.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from fpirhc.contraction.spectrum import response_jacobians
from fpirhc.errors import NotSupported
from fpirhc.review.grid import ReviewGrid, review_grid
from fpirhc.review.loops import ideal_loops, ideal_places
from fpirhc.review.prediction import NominalRun, ResponseErrors
from fpirhc.review.state_slopes import state_slopes
from fpirhc.simulation.linearise.linear_loop import LinearLoop

_POINTS = 5  # of the reference, whose impulse responses are compared
_GONE = 1e-6  # share of its largest value below which an impulse response is over
_ROUNDING = 1e-15  # entry of a product of I - a J, which adds nothing any more
_LOST = 1e6  # entry of a product of I - a J, from which errors grow


def tube(nominal: NominalRun, errors: ResponseErrors, gain: float, exact: np.ndarray | None = None) -> np.ndarray:
    """Return the bound of |x_k - x^_k| (cycles + 1, nx) that the response errors allow, with x^_k the states of the nominal run.

    Args:
        nominal: the nominal run.
        errors: the response errors that the deformation leaves.
        gain: effective gain of the deformation.
        exact: exact parameters, shape (np,); None: the plant's.

    Raises:
        NotSupported: coordinates that are not controlled, no linear loop, one that does not converge even with the
            right model.
    """
    plant = nominal.problem.plant
    if plant.outputs:
        raise NotSupported("no tube: the nominal run of outputs is that of the plant, and a tube is around the model's")
    if len(plant.controlled_names) < len(plant.names):
        raise NotSupported("no tube: a coordinate that is not controlled moves by itself")
    force = majorant(nominal, errors, gain, exact) + np.abs(errors.force - errors.error)
    grid = review_grid(nominal.problem, 0.0, 0)
    loops = ideal_loops(grid, nominal.controller, _POINTS)
    effects = [_effect(grid, nominal, k) for k in ideal_places(grid, nominal.believed, _POINTS)]
    answers = [_impulses(*one, nominal.cycles) for one in zip(loops, effects, strict=True)]
    longest = max(len(a) for a in answers)
    largest = np.max([np.pad(a, ((0, longest - len(a)), (0, 0), (0, 0))) for a in answers], axis=0)
    bound = np.zeros((nominal.cycles + 1, largest.shape[1]))
    summed = _convolved(largest, force[:, None, :]).sum(axis=2)
    bound[1:] = np.maximum(summed[: nominal.cycles], 0.0)
    return bound


def majorant(nominal: NominalRun, errors: ResponseErrors, gain: float, exact: np.ndarray | None = None) -> np.ndarray:
    """Return e+ (cycles, n); the size of the errors where products of I - a J do not decay; arguments as in `tube`."""
    plant = nominal.problem.plant
    rows = np.tile(plant.exact if exact is None else exact, (nominal.cycles, 1))
    jacobians = response_jacobians(plant, nominal.states[:-1], nominal.desired, rows, nominal.believed)
    factors, size = np.eye(jacobians.shape[1]) - gain * jacobians, np.abs(errors.error)
    if gain == 0 or not np.isfinite(factors).all():
        return size
    parts = size.copy()
    parts[1:] = np.abs(errors.error[1:] - np.einsum("kij,kj->ki", factors[1:], errors.error[:-1]))
    bound, carried = parts.copy(), factors.copy()
    for late in range(1, nominal.cycles):  # cycles after which a part is still felt
        bound[late:] += np.einsum("kij,kj->ki", np.abs(carried[late:]), parts[:-late])
        largest = np.abs(carried[late:]).max()
        if largest < _ROUNDING:
            return bound
        if largest > _LOST:
            break
        carried[late + 1 :] = carried[late + 1 :] @ factors[1:-late]
    return size


def _effect(grid: ReviewGrid, nominal: NominalRun, place: int) -> np.ndarray:
    """The model's gain (n, nu) from inputs to responses at a point."""
    at = grid.states[place], grid.needed(nominal.believed)[place], nominal.believed
    return state_slopes(grid.problem.plant, *at).d


def _impulses(loop: LinearLoop, gain: np.ndarray, cycles: int) -> np.ndarray:
    """|h_j| (j, nx, n): the motion of the states after a unit of the responses over one cycle."""
    if loop.radius >= 1:
        raise NotSupported("no tube: the loop does not converge even with the right model")
    sizes = np.abs(loop.impulses(np.linalg.inv(gain), cycles)).max(
        axis=0
    )  # of all cycles of a period in which the unit may come
    lasting = sizes.max(axis=(1, 2)) >= _GONE * sizes.max()
    return np.asarray(sizes[: int(np.flatnonzero(lasting).max(initial=0)) + len(loop.cycles)])


def _convolved(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Convolution along the first axis, as in scipy.signal, whose import takes longer than all of this."""
    length = len(one) + len(other) - 1
    padded = next_fast_len(length, real=True)
    convolved: np.ndarray = irfft(rfft(one, padded, axis=0) * rfft(other, padded, axis=0), padded, axis=0)
    return convolved[:length]
