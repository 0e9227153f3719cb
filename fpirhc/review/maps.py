"""What a deformation is made of, as far as a review needs to know."""

from __future__ import annotations

import math

from fpirhc.controllers.gain_check import product_limit
from fpirhc.deformation.base import Deformation
from fpirhc.task.problem import Problem


def dead_cycles(problem: Problem) -> float:
    """Longest dead time between a request and its response, in control cycles beyond the one that every loop has."""
    longest = max(problem.dead_time.inputs.values(), default=0.0)
    return (longest + problem.dead_time.measurement) / problem.period


def largest_product(problem: Problem, deformation: Deformation) -> float:
    """Limit of effective gain times eigenvalue: 2, or less under a dead time or behind an estimator or a filter.

    Under a dead time, unpaired: 2 sin(pi / (2 (2 d + 1))), d rounded up. Paired with the true dead time: 2. Paired with an
    uncertainty or with another dead time: 0.5, up to which the remembered requests decay.
    """
    pairs, cycles, delayed = deformation.pairing, dead_cycles(problem), product_limit(problem, deformation)
    if pairs is not None and pairs.cycles is None:
        pairs = None  # the pair is estimated on line, from none on
    if delayed is not None and (pairs is None or pairs.uncertainty == 0):
        return delayed
    if pairs is None:
        return 2 * math.sin(math.pi / (2 * (2 * math.ceil(cycles - 1e-9) + 1)))
    exact = pairs.uncertainty == 0 and pairs.cycles is not None and abs(pairs.cycles - cycles) < 1e-6
    return 2.0 if exact else 0.5
