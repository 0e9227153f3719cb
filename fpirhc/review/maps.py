"""Facts about dead time and deformations that several questions share."""

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
    """Return the limit of effective gain times eigenvalue: 2, or less under a dead time or behind an estimator or a filter.

    With a dead time of d cycles the limit is, for a map

        without pairing                               2 sin(pi / (2 (2 d + 1))), d rounded up
        paired with the true dead time                2
        with the leak p, paired wrongly by m cycles   the g of 4 p / (1 - p)^2 = g (2 + g) m^2, at most 2
        without a leak, paired wrongly                0.5, up to which the remembered requests decay
        paired with a mean of requests                0.5 without a leak.
    """
    pairs, leak, cycles = deformation.pairing, deformation.leak, dead_cycles(problem)
    averaged, own = pairs is not None and pairs.uncertainty > 0, (pairs.cycles or 0.0) if pairs else 0.0
    delayed = None if averaged else product_limit(problem, deformation)
    if delayed is not None:
        return delayed
    wrong = abs(own - cycles)
    if own == 0 and not leak:
        return 2 * math.sin(math.pi / (2 * (2 * math.ceil(cycles - 1e-9) + 1)))
    if wrong < 1e-6 and not averaged:
        return 2.0
    return min(2.0, math.sqrt(1 + 4 * leak / ((1 - leak) * wrong) ** 2) - 1) if leak else 0.5
