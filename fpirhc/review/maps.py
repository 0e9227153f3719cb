"""Facts about dead time and deformations that several questions share."""

from __future__ import annotations

import math

import numpy as np

from fpirhc.contraction.delayed import leaking_limit
from fpirhc.controllers.gain_check import product_limit
from fpirhc.deformation.base import Deformation
from fpirhc.task.problem import Problem

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
    sizes = np.array([1.0]) if eigenvalues is None or deformation.mirror is None else np.abs(eigenvalues)
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
        referenced=deformation.mirror is not None,
        width=pairing.uncertainty if pairing else 0,
    )
    return min(limit * size, _LIMIT)
