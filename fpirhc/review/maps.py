"""What a deformation is made of, as far as a review needs to know."""

from __future__ import annotations

import math

from fpirhc.controllers.gain_check import product_limit
from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.rfpt import RFPT
from fpirhc.deformation.rfpt_vector import RFPTVector
from fpirhc.deformation.rotation import Rotation
from fpirhc.deformation.sigmoid import Sigmoid
from fpirhc.deformation.wrappers.base import Wrapper
from fpirhc.deformation.wrappers.delayed import Increment, Paired
from fpirhc.deformation.wrappers.filtered import Filtered
from fpirhc.deformation.wrappers.self_paired import DelayWatched
from fpirhc.task.problem import Problem

_CONSTANT = (Affine, RFPT, RFPTVector, Rotation, Sigmoid, Paired, Increment, Filtered, DelayWatched)


def innermost(deformation: Deformation) -> Deformation:
    """The map inside all wrappers."""
    while isinstance(deformation, Wrapper):
        deformation = deformation.map
    return deformation


def constant(deformation: Deformation) -> bool:
    """Whether the map and its wrappers keep the gain and the pairing that they begin with."""
    if not isinstance(deformation, _CONSTANT):
        return False
    return constant(deformation.map) if isinstance(deformation, Wrapper) else True


def paired(deformation: Deformation) -> Paired | Increment | None:
    """The wrapper that pairs responses with earlier requests, if there is one."""
    while isinstance(deformation, Wrapper):
        if isinstance(deformation, Paired | Increment):
            return deformation
        deformation = deformation.map
    return None


def dead_cycles(problem: Problem) -> float:
    """Longest dead time between a request and its response, in control cycles beyond the one that every loop has."""
    longest = max(problem.dead_time.inputs.values(), default=0.0)
    return (longest + problem.dead_time.measurement) / problem.period


def largest_product(problem: Problem, deformation: Deformation) -> float:
    """Limit of effective gain times eigenvalue: 2, or less under a dead time or behind an estimator or a filter.

    Under a dead time, unpaired: 2 sin(pi / (2 (2 d + 1))), d rounded up. Paired with the true dead time: 2. Paired with an
    uncertainty or with another dead time: 0.5, up to which the remembered requests decay.
    """
    pairs, cycles, delayed = paired(deformation), dead_cycles(problem), product_limit(problem, deformation)
    if delayed is not None and (pairs is None or pairs.uncertainty == 0):
        return delayed
    if pairs is None:
        return 2 * math.sin(math.pi / (2 * (2 * math.ceil(cycles - 1e-9) + 1)))
    return 2.0 if pairs.uncertainty == 0 and abs(pairs.cycles - cycles) < 1e-6 else 0.5
