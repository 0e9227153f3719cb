"""What an observer or a predictor finds beside the model is taken off: ADRC and L1 adaptive control. Theory: docs/theory.md."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.controllers.base import closing_blocks, invert_block, nominal_blocks, tracked_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import OfDerivatives
from fpirhc.fields.kinds import Positive
from fpirhc.members import Example
from fpirhc.plant.maps import check_modes, step_of
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite, left_in_mean, power, total
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar, vector
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking, decay_gains, error_chains, own_errors


@dataclass(frozen=True)
class ADRC(OfDerivatives):
    """Linear active disturbance rejection control of every controlled coordinate.

    Args:
        bandwidth: w_c of the controller, 1/s.
        observer: w_o of the extended state observer, 1/s.
    """

    bandwidth: Positive
    observer: Positive

    def check(self, problem: Problem) -> None:
        """Raise for an output of order 0, or an error that does not decay in the steps of a map."""
        super().check(problem)
        for order in problem.plant.response_orders.values():
            check_modes(self, problem.plant, decay_gains(self.bandwidth, order))

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        closing, delays = closing_blocks(built)
        blocks = [*nominal_blocks(built), self._observer_block(built), *closing, _prediction_block(built)]
        return blocks, [*delays, Delay(_states(plant, "_predicted"), "_predicted_later")]

    def corrections(self, plant: Plant, order: int, period: float) -> list[float]:
        """Return l_1 ... l_{n+1} of z += l (y - z_1), for a coordinate of that relative order; all poles at ca.exp(-w_o T).

        The correction of the newest sample places all poles of (1 - l c) Phi, whose polynomial is affine in l.
        """
        size, pole = order + 1, ca.exp(-self.observer * period)
        chain = step_of(plant, np.eye(size, k=1), period)
        free = np.poly(chain)[1:]
        effect = np.column_stack([np.poly(chain - np.outer(one, chain[0]))[1:] - free for one in np.eye(size)])
        wanted = [math.comb(size, k) * power(-pole, k) - float(free[k - 1]) for k in range(1, size + 1)]
        rows = np.linalg.inv(effect)
        return [sum(float(share) * value for share, value in zip(row, wanted, strict=True)) for row in rows]

    def _observer_block(self, built: Built) -> Block:
        """Block (outputs, prediction, reference) -> (command, extended state)."""
        plant, orders = built.plant, list(built.plant.response_orders.values())
        gain, response = plant.equations.input_gain, plant.equations.controlled_response

        def step(s: Signals) -> dict[str, Expression]:
            seen, target = getattr(s, plant.output.name), error_chains(plant, s.reference)
            states, feedback = [], []
            for k, (y, predicted) in enumerate(zip(own_errors(plant, seen), _split(s._predicted, orders), strict=True)):
                begun = s.warm_up > 0.5
                # The observer begins at the first sample, with the derivatives of the reference and no disturbance.
                before = [ca.if_else(begun, z, r) for z, r in zip(predicted, [y, *target[k][1:], 0 * y], strict=True)]
                shares = self.corrections(plant, orders[k], built.period)
                z = [x + share * (y - before[0]) for x, share in zip(before, shares, strict=True)]
                errors = zip(decay_gains(self.bandwidth, orders[k]), target[k], z[:-1], strict=True)
                feedback.append(total(g * (r - x) for g, r, x in errors))
                states += z
            disturbance = ca.vertcat(*(z[-1] for z in _split(ca.vertcat(*states), orders)))
            desired = s.nominal + ca.vertcat(*feedback)
            command = ca.solve(gain(s.state, s._command_before, s.parameters), desired - disturbance)
            return {
                "extended_state": ca.vertcat(*states),
                "desired": desired,
                "command_unclipped": command,
                "_deformed_unclipped": response(s.state, command, s.parameters),
            }

        measured = dict.fromkeys((plant.state, plant.output))
        known = (like(plant.output, "reference"), plant.response_signal("nominal"), plant.parameter)
        reads = Layout((*measured, *known, built.before, scalar("warm_up"), _states(plant, "_predicted")))
        responses = map(plant.response_signal, ("desired", "_deformed_unclipped"))
        writes = Layout((_states(plant, "extended_state"), *responses, like(plant.input, "command_unclipped")))
        return Block("observer", reads, writes, step)


def _prediction_block(built: Built) -> Block:
    """Block (extended state, command) -> the extended state before the next sample."""
    plant, gain, orders = (built.plant, built.plant.equations.input_gain, list(built.plant.response_orders.values()))
    acting, predicted = plant.response_signal("acting"), _states(plant, "_predicted")

    def later(states: Expression, effect: Expression) -> Expression:
        moved = []
        for chain, own in zip(_split(states, orders), ca.vertsplit(effect), strict=True):
            step = step_of(plant, np.eye(len(chain), k=1), built.period)
            step_of_effect = [*step[:-1, -1], 0.0]  # a held input acts as the disturbance does, and does not change it
            moved.append(ca.DM(step) @ ca.vertcat(*chain) + ca.DM(step_of_effect) * own)
        return ca.vertcat(*moved)

    def step(s: Signals) -> dict[str, Expression]:
        effect = gain(s.state, s.command, s.parameters) @ s.command
        states = later(s.extended_state, effect)
        usable = is_finite(ca.vertcat(states, effect))
        return {
            "_predicted_later": ca.if_else(usable, states, s._predicted),
            "acting_next": ca.if_else(usable, effect, s.acting),
        }

    reads = Layout((plant.state, plant.input, plant.parameter, _states(plant, "extended_state"), predicted))
    writes = Layout((_states(plant, "_predicted_later"),))
    return Block("prediction", reads, writes, step, Layout((acting,)))


def _states(plant: Plant, name: str) -> Signal:
    """Signal of z_1 ... z_{n+1} of every controlled coordinate, one after another."""
    orders = plant.response_orders.items()
    units = dict(zip(plant.output.elements, plant.output.entry_units, strict=True))
    responses = dict(zip(plant.controlled_names, plant.response_signal("_").entry_units, strict=True))
    elements = [(c + "'" * k, units.get(c + "'" * k, responses[c])) for c, order in orders for k in range(order + 1)]
    return vector(name, tuple(e for e, _ in elements), tuple(u for _, u in elements))


def _split(states: Expression, orders: list[int]) -> list[list[Expression]]:
    """The extended states of every controlled coordinate."""
    entries = iter(ca.vertsplit(states))
    return [[next(entries) for _ in range(order + 1)] for order in orders]


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
        blocks, delays = tracked_blocks(built, self.tracking, self._predictor_block(built), invert_block(plant))
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


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="ADRC", changes={"duration": 3.0, "measure_from": 0.0}, left=0.15),
    Example(problem="mrac_pendulum", controller="L1 adaptive", changes={"duration": 3.0, "measure_from": 0.0}),
)
