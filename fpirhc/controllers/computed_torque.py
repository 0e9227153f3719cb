"""The model's inverse along a reference: with a tracking law and a deformation, or open loop.

q^Des = q^(r),N + feedback of the tracking law,        u = inverse model of the deformed q^Des
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca

from fpirhc.controllers.base import Controller, closing_blocks, reference_block, tracked_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import Undeformed
from fpirhc.deformation.base import Deformation, Identity
from fpirhc.deformation.sigmoid import Sigmoid
from fpirhc.errors import InvalidProblem, require
from fpirhc.members import Example
from fpirhc.status import Status
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, like, scalar
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

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return tracked_blocks(built, self.tracking, deformation=self.deformation)


_SEEN = "_seen_status"


@dataclass(frozen=True)
class FeedforwardOnly(Undeformed):
    """The model's inverse at the reference's state and response; no error is fed back."""

    def check(self, problem: Problem) -> None:
        """Raise if the model has no inverse, or a derivative is prescribed where states have no reference."""
        plant = problem.plant
        if len(plant.controlled_names) != len(plant.inputs):
            raise InvalidProblem("FeedforwardOnly needs as many controlled coordinates as inputs")
        slow = ", ".join(name for name in plant.controlled_names if name not in plant.at_once)
        if slow:
            require(
                not plant.equations.hidden,
                f"FeedforwardOnly does not cover outputs that are expressions of the state ({slow}): without feedback their "
                "errors would add up; use a controller with a tracking law",
            )

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        closing, delays = closing_blocks(built, judged=[scalar(_SEEN)])
        return [reference_block(built), self._block(built), *closing], delays

    def _block(self, built: Built) -> Block:
        """Block (reference, state, parameters) -> command, and the response that the model expects of it."""
        plant, wanted = built.plant, built.plant.response_signal("_reference_response")
        inverse, response = plant.equations.inverse, plant.equations.controlled_response

        def step(s: Signals) -> dict[str, Expression]:
            nominal = plant.equations.state_of(s.reference, s.state)
            command = inverse(nominal, s._reference_response, s.parameters)
            # A bad measurement changes no command here, and is a bad measurement all the same.
            finite = is_finite(s.state)
            return {
                "nominal": s._reference_response,
                "desired": s._reference_response,
                "command_unclipped": command,
                "_deformed_unclipped": ca.if_else(
                    finite, response(s.state, command, s.parameters), s._reference_response
                ),
                _SEEN: ca.if_else(finite, int(Status.OK), int(Status.NON_FINITE)),
            }

        responses = [plant.response_signal(name) for name in ("nominal", "desired", "_deformed_unclipped")]
        reads = (like(plant.output, "reference"), wanted, plant.state, plant.parameter)
        writes = Layout((*responses, like(plant.input, "command_unclipped"), scalar(_SEEN)))
        return Block("feedforward", Layout(reads), writes, step, opaque=plant.equations.inverse_opaque)


EXAMPLES = (
    ComputedTorque(Exponential(rate=8.0)),
    ComputedTorque(Exponential(rate=8.0), Sigmoid(gain=-0.5, scale=50.0)),
    # Open loop: what is left is the dead time of the problem.
    Example(problem="heat_exchanger", controller="static inverse", left=0.4, changes={"reality": None}),
)
