"""Computed torque: track the reference with the model's inverse, with or without deformation.

q^Des = q^(r),N + feedback of the tracking law;   u = inverse model of the deformed q^Des.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fpirhc.controllers.base import Controller, tracked_blocks
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.identity import Identity
from fpirhc.deformation.sigmoid import Sigmoid
from fpirhc.symbolic.block import Block, Delay
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking
from fpirhc.tracking.linear_law import Exponential


@dataclass(frozen=True)
class ComputedTorque(Controller):
    """Inverse dynamics with a tracking law; adaptive with a deformation.

    Args:
        tracking: the law that gives the desired response.
        deformation: the map between desired response and request; Identity() is no adaptation.
    """

    tracking: Tracking
    deformation: Deformation = field(default_factory=Identity)

    def blocks(self, problem: Problem) -> tuple[list[Block], list[Delay]]:
        return tracked_blocks(problem, self.tracking, self.deformation)


EXAMPLES = (
    ComputedTorque(Exponential(rate=8.0)),
    ComputedTorque(Exponential(rate=8.0), Sigmoid(gain=-0.5, scale=50.0)),
)
