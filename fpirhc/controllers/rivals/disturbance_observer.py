"""A disturbance observer around the model's inverse: what the model's input differs by is taken off the next command.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import law_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import PairedAtOnce
from fpirhc.fields.kinds import Positive
from fpirhc.members import Example
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, like, scalar
from fpirhc.tracking.base import Tracking


@dataclass(frozen=True)
class DisturbanceObserver(PairedAtOnce):
    """Inverse dynamics less the observed disturbance at the input. Dead time is not compensated.

    Args:
        tracking: the law that gives the desired response.
        bandwidth: g of the low-pass Q, 1/s.
    """

    tracking: Tracking
    bandwidth: Positive

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return law_blocks(built, self.tracking, self._observer_block(built))

    def _observer_block(self, built: Built) -> Block:
        """Block (state, last command, realised, desired) -> (command, disturbance at the input)."""
        plant, warm_up_cycles, pole = built.plant, built.warm_up, ca.exp(-self.bandwidth * built.period)
        response, inverse = plant.equations.controlled_response, plant.equations.inverse
        disturbance = like(plant.input, "input_disturbance")

        def step(s: Signals) -> dict[str, Expression]:
            needed = inverse(s.state, s.realised, s.parameters)
            observed = pole * s.disturbance_before + (1 - pole) * (needed - s._command_before)
            running = s.warm_up > warm_up_cycles - 0.5
            used = ca.if_else(running, observed, 0)
            command = inverse(s.state, s.desired, s.parameters) - used
            return {
                "command_unclipped": command,
                "_deformed_unclipped": response(s.state, command, s.parameters),
                "input_disturbance": used,
                # A measurement that is not finite must not stay in the filter.
                "disturbance_before_next": ca.if_else(is_finite(used), used, s.disturbance_before),
            }

        signals = (built.before, plant.response_signal("realised"), plant.response_signal("desired"))
        reads = Layout((plant.state, *signals, plant.parameter, scalar("warm_up")))
        request = plant.response_signal("_deformed_unclipped")
        writes = Layout((like(plant.input, "command_unclipped"), request, disturbance))
        memory = Layout((like(plant.input, "disturbance_before"),))
        return Block("observer", reads, writes, step, memory, opaque=plant.equations.inverse_opaque)


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="disturbance observer", changes={"duration": 3.0, "measure_from": 0.0}),
)
