"""The blocks of a controller that tracks the reference with a law and inverts the model.

q^Des = q^(r),N + feedback of the tracking law;   u = inverse model of the deformed q^Des.
"""

from __future__ import annotations

from fpirhc.controllers.base import closing_blocks, like, reference_block, rename
from fpirhc.controllers.reference_states import largest_response
from fpirhc.deformation.base import Deformation
from fpirhc.symbolic.block import Block, Delay
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking


def bounded(problem: Problem, tracking: Tracking) -> Tracking:
    """Return the law with its memory bounded by what the problem's limits can need."""
    return tracking.within(largest_response(problem))


def desired_blocks(problem: Problem, tracking: Tracking) -> list[Block]:
    """Return the blocks reference, target, nominal and tracking: together they write 'desired'."""
    plant = problem.plant
    return [
        reference_block(problem),
        rename("target", like(plant.output, "reference"), like(plant.output, "_target")),
        rename("nominal", plant.response_signal("_reference_response"), plant.response_signal("nominal")),
        bounded(problem, tracking).law(plant, problem.period),
    ]


def tracked_blocks(problem: Problem, tracking: Tracking, deformation: Deformation) -> tuple[list[Block], list[Delay]]:
    """Return the blocks reference, tracking, deform, invert, limit, judge, running, tracking update, and what they remember."""
    plant = problem.plant
    closing, delays = closing_blocks(problem, deformation)
    update = bounded(problem, tracking).update(plant, problem.period)
    return [*desired_blocks(problem, tracking), *closing, update], [*delays, *tracking.delays(plant)]
