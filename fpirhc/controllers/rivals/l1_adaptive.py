"""L1 adaptive control with the piecewise-constant law: a predictor of the highest measured derivative, and a low-pass.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import invert_block, law_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import OfDerivatives
from fpirhc.fields.kinds import Positive
from fpirhc.members import Example
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite, left_in_mean
from fpirhc.symbolic.layout import Expression, Layout, scalar
from fpirhc.tracking.base import Tracking, error_chains


@dataclass(frozen=True)
class L1Adaptive(OfDerivatives):
    """Inverse dynamics less the low-passed estimate of a fast predictor.

    Args:
        tracking: the law that gives the desired response.
        bandwidth: w_c of the low-pass on the estimate, rad/s.
        predictor: a_s, 1/s; a_s T well below one leaves little of a constant residual.
    """

    tracking: Tracking
    bandwidth: Positive
    predictor: Positive = 1.0

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        blocks, delays = law_blocks(built, self.tracking, self._predictor_block(built), invert_block(plant))
        expected = plant.response_signal("_expected")
        return [*blocks, _expected_block(plant)], [*delays, Delay(expected, "_expected_now")]

    def _predictor_block(self, built: Built) -> Block:
        """Block (state or outputs, desired, response that the model expected of the last command) -> request."""
        plant, period = built.plant, built.period
        left, pole = ca.exp(-self.predictor * period), ca.exp(-self.bandwidth * period)
        moves = period * left_in_mean(period, 1 / self.predictor)  # (1 - left) / a_s
        gain = left / moves
        names = ("predictor_error", "predictor_input", "measured_before", "disturbance_before")
        memory = Layout((*map(plant.response_signal, names), scalar("predictor_begun")))

        def step(s: Signals) -> dict[str, Expression]:
            chains = error_chains(plant, getattr(s, plant.output.name))
            measured = ca.vertcat(*(chain[-1] for chain in chains))
            velocity = (measured - s.measured_before) / period
            begun = s.predictor_begun > 0.5
            error = left * s.predictor_error + moves * (s._expected + s.predictor_input - velocity)
            error = ca.if_else(begun, error, 0)
            estimate = -gain * error
            disturbance = pole * s.disturbance_before - ((1 - pole) * gain) * error
            usable = is_finite(ca.vertcat(error, disturbance, measured))
            after = {
                "predictor_error": error,
                "predictor_input": estimate,
                "measured_before": measured,
                "disturbance_before": disturbance,
            }
            remembered = {f"{n}_next": ca.if_else(usable, value, getattr(s, n)) for n, value in after.items()}
            return {
                "_deformed_unclipped": s.desired - disturbance,
                "response_disturbance": disturbance,
                **remembered,
                "predictor_begun_next": ca.if_else(usable, 1, 0),
            }

        reads = Layout((plant.output, plant.response_signal("desired"), plant.response_signal("_expected")))
        writes = Layout((plant.response_signal("_deformed_unclipped"), plant.response_signal("response_disturbance")))
        return Block("predictor", reads, writes, step, memory)


def _expected_block(plant: Plant) -> Block:
    """Block (state, command) -> the response that the model expects of it."""
    response = plant.equations.controlled_response

    def step(s: Signals) -> dict[str, Expression]:
        return {"_expected_now": response(s.state, s.command, s.parameters)}

    reads = Layout((plant.state, plant.input, plant.parameter))
    return Block("expected", reads, Layout((plant.response_signal("_expected_now"),)), step)


EXAMPLES = (Example(problem="mrac_pendulum", controller="L1 adaptive", changes={"duration": 3.0, "measure_from": 0.0}),)
