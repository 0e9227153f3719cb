"""Cycles that the caller missed: the time of a step is more than one period after that of the step before.

A missed cycle is one whose sample is missing. The command of the last step went on acting in it, as in every cycle that is skipped.
"""

from __future__ import annotations

import math

from fpirhc.simulation.clock import LONGEST
from fpirhc.symbolic.finite import FINITE
from fpirhc.task.problem import Problem

_STEPS = 500


def missed_cycles(time: float, before: float, period: float) -> int:
    """Return how many cycles lie between two steps; 0 where the later one is the next cycle, or cannot follow the other.

    Args:
        time: of the step.
        before: time of the step before it, as the clock remembers it; -FINITE: there was none.
        period: of the control cycle.
    """
    cycles = (time - before) / period
    return round(cycles) - 1 if before > -FINITE / 2 and 1.5 <= cycles <= LONGEST else 0


def most_missed(problem: Problem, bridged: int) -> int:
    """Return the number of missed cycles that are stepped over, so that the time of a step has a bound.

    Beyond it estimators begin anew, and queues hold nothing but the held command; an observer is predicted no further.

    Args:
        problem: of the step.
        bridged: number of missing cycles up to which a gap is bridged; queues go on for their whole length.
    """
    late = problem.dead_time
    longest = max((*late.inputs.values(), *late.longest.values()), default=0.0)
    return max(_STEPS, bridged + 1) + math.ceil((longest + late.measurement) / problem.period)
