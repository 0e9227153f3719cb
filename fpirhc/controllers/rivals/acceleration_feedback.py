"""Computed torque with feedback of the measured response: u = model(q^Des) + K (q^Des - q^(n)).

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import invert_block, law_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import Undeformed
from fpirhc.fields.kinds import NotNegative, Positive
from fpirhc.members import Example
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite, left_after
from fpirhc.symbolic.layout import Expression, Layout, scalar
from fpirhc.tracking.base import Tracking


@dataclass(frozen=True)
class AccelerationFeedback(Undeformed):
    """Inverse dynamics of q^Des + kappa (q^Des - q^(n)), with the measured response q^(n).

    Args:
        tracking: the law that gives the desired response.
        gain: kappa, dimensionless.
        time_constant: of the low-pass on the response error, s; 0: no low-pass.
    """

    tracking: Tracking
    gain: Positive
    time_constant: NotNegative = 0.0

    def pole(self, period: float) -> float:
        """Return the pole p of the low-pass for control cycles of that period, s."""
        return left_after(period, self.time_constant)

    def largest_gain(self, period: float) -> float:
        """Return the stability limit (1 + p) / (1 - p) of kappa lambda_max(J) for control cycles of that period, s."""
        return (1 + self.pole(period)) / (1 - self.pole(period))

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return law_blocks(built, self.tracking, self._feedback_block(built), invert_block(built.plant))

    def _feedback_block(self, built: Built) -> Block:
        """Block (desired, realised) -> request; before the first response the request is the desired response."""
        plant, pole, warm_up_cycles = built.plant, self.pole(built.period), built.warm_up
        memory = Layout((plant.response_signal("filtered_error"),))

        def step(s: Signals) -> dict[str, Expression]:
            error = pole * s.filtered_error + (1 - pole) * (s.realised - s.desired)
            # A measurement that is not finite must not stay in the filter.
            running = s.warm_up > warm_up_cycles - 0.5
            usable = ca.logic_and(running, is_finite(error))
            request = s.desired - self.gain * ca.if_else(running, error, 0)
            return {"_deformed_unclipped": request, "filtered_error_next": ca.if_else(usable, error, s.filtered_error)}

        reads = (plant.response_signal("desired"), plant.response_signal("realised"), scalar("warm_up"))
        return Block("feedback", Layout(reads), Layout((plant.response_signal("_deformed_unclipped"),)), step, memory)


EXAMPLES = (
    Example(
        problem="mrac_pendulum", controller="acceleration feedback", changes={"duration": 3.0, "measure_from": 0.0}
    ),
)
