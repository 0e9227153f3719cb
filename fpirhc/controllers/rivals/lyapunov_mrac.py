"""Direct model reference adaptive control by Lyapunov's method: gains adapted by the rule e'PB, the classical counterpart.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from fpirhc.controllers.base import commanding_blocks, reference_block
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import OfDerivatives
from fpirhc.controllers.rivals.reference_model import companion, decay_gains, model_block
from fpirhc.errors import Mistakes
from fpirhc.fields.kinds import NotNegative, Positive
from fpirhc.members import Example
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, power
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import error_chains


@dataclass(frozen=True)
class LyapunovMRAC(OfDerivatives):
    """Gains on state, reference and bias, adapted so that the plant becomes the reference model.

    Args:
        rate: of the reference model, 1/s.
        adaptation: gamma, in units of the input times s^(2n-1) per squared unit of the coordinate.
        leakage: rate with which the gains return to those of the model, 1/s.
    """

    rate: Positive
    adaptation: Positive
    leakage: NotNegative = 0.0

    learns = of_time = True

    def weights(self, order: int) -> np.ndarray:
        """Return P of the scaled error z for one coordinate, shape (order, order)."""
        return np.asarray(solve_continuous_lyapunov(companion(decay_gains(1.0, order)).T, -np.eye(order)))

    def check(self, problem: Problem) -> None:
        """Raise if the proof of the rule does not cover the plant.

        Raises:
            NotSupported: a map, or an output of order 0.
            InvalidProblem: not fully actuated, or the inputs' effect on the response is not of one sign at the start.
        """
        super().check(problem)
        plant, mistakes = problem.plant, Mistakes("LyapunovMRAC")
        followed = plant.chains
        if len(plant.controlled_names) != len(followed):
            free = [c for c in followed if c not in plant.controlled_names]
            mistakes.add(f"the plant is not fully actuated: '{free[0]}' has no input of its own; use ComputedTorque")
        elif _sign(problem) == 0:
            mistakes.add(
                "the inputs' effect on the response is not definite at the start, so the rule may enlarge the error; "
                "order the inputs as the coordinates, each with a positive effect on its own"
            )
        mistakes.raise_if_any()

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        closing, delays = commanding_blocks(built)
        blocks = [
            reference_block(built),
            model_block(plant, self.rate, built.period),
            self._law_block(plant),
            *closing,
            self._adapt_block(plant, built.period, _sign(built.problem)),
        ]
        gains, first = _gains(plant, "_gains_before"), _gains(plant, "_gains_first_before")
        return blocks, [*delays, Delay(gains, "gains"), Delay(first, "_gains_first")]

    def _law_block(self, plant: Plant) -> Block:
        """Block (state, model, reference, gains) -> command, regressor, p z, and the gains in use."""
        seen = plant.output
        rows = [self.weights(order)[-1] for order in plant.response_orders.values()]
        start, response, rate = _start_gains(plant), plant.equations.controlled_response, self.rate

        def pull(row: np.ndarray, chain: list[Expression]) -> Expression:
            return sum(w * power(rate, len(chain) - 1 - j) * e for j, (w, e) in enumerate(zip(row, chain, strict=True)))

        def step(s: Signals) -> dict[str, Expression]:
            motion = getattr(s, seen.name)
            errors = error_chains(plant, s.reference - motion)
            feedback = [ca.dot(ca.vertcat(*decay_gains(rate, len(c))), ca.vertcat(*c)) for c in errors]
            desired = s._reference_response + ca.vertcat(*feedback)
            begun = start(s.state, desired, s.parameters)
            first = ca.if_else(s.warm_up > 0.5, s._gains_first_before, begun)
            gains = ca.if_else(s.warm_up > 0.5, s._gains_before, begun)
            regressor = ca.vertcat(s.state, desired, 1)
            command = ca.mtimes(ca.reshape(gains, desired.numel(), regressor.numel()), regressor)
            chains = error_chains(plant, s.model - motion)
            return {
                "desired": desired,
                "command_unclipped": command,
                "_deformed_unclipped": response(s.state, command, s.parameters),
                "_pull": ca.vertcat(*(pull(row, chain) for row, chain in zip(rows, chains, strict=True))),
                "_regressor": regressor,
                "_gains_used": gains,
                "_gains_first": first,
            }

        before = [_gains(plant, n) for n in ("_gains_before", "_gains_first_before")]
        motions = [like(seen, n) for n in ("model", "reference")]
        reads = (
            *plant.motion,
            *motions,
            plant.response_signal("_reference_response"),
            plant.parameter,
            scalar("warm_up"),
        )
        writes = (
            plant.response_signal("desired"),
            like(plant.input, "command_unclipped"),
            plant.response_signal("_deformed_unclipped"),
            *_adapted(plant),
        )
        return Block("law", Layout((*reads, *before)), Layout(writes), step, opaque=plant.equations.inverse_opaque)

    def _adapt_block(self, plant: Plant, period: float, sign: int) -> Block:
        """Block that steps the gains, except those of an input that the rule moves further into its limit."""

        def step(s: Signals) -> dict[str, Expression]:
            pull = sign * s._pull
            # No side of a comparison where a command is not a number, so that its gains stay too.
            counts = pull * (s.command_unclipped - s.command) <= 0
            rule = self.adaptation * ca.vec(ca.mtimes(pull, s._regressor.T))
            change = rule - self.leakage * (s._gains_used - s._gains_first)
            return {"gains": s._gains_used + period * ca.if_else(ca.repmat(counts, s._regressor.numel()), change, 0)}

        reads = Layout((like(plant.input, "command_unclipped"), plant.input, *_adapted(plant)))
        return Block("adapt", reads, Layout((_gains(plant, "gains"),)), step)


def _regressed(plant: Plant) -> tuple[str, ...]:
    return (*plant.state.elements, *(f"v_{c}" for c in plant.controlled_names), "bias")


def _gains(plant: Plant, name: str) -> Signal:
    """Theta column by column: torque_angle is the gain of the angle in the torque."""
    return Signal(name, tuple(f"{u}_{x}" for x in _regressed(plant) for u in plant.input.elements))


def _adapted(plant: Plant) -> tuple[Signal, ...]:
    """Signals of the law that the adaptation reads."""
    own = (Signal("_pull", plant.controlled_names), Signal("_regressor", _regressed(plant)))
    return (*own, _gains(plant, "_gains_used"), _gains(plant, "_gains_first"))


def _start_gains(plant: Plant) -> ca.Function:
    """Function (state, desired response, parameters) -> Theta_0: the model's inverse, linearised there."""
    x, r = ca.MX.sym("x", plant.state.size), ca.MX.sym("r", len(plant.controlled_names))
    p = ca.MX.sym("p", len(plant.parameters))
    command = plant.equations.inverse(x, r, p)
    by_state, by_response = ca.densify(ca.jacobian(command, x)), ca.densify(ca.jacobian(command, r))
    bias = command - ca.mtimes(by_state, x) - ca.mtimes(by_response, r)
    return ca.Function("fpirhc_start_gains", [x, r, p], [ca.vec(ca.horzcat(by_state, by_response, bias))])


def _sign(problem: Problem) -> int:
    """Sign of the inputs' effect on the response by the model at the start; 0 where it is not definite."""
    plant = problem.plant
    matrix = np.asarray(
        plant.equations.input_gain(problem.start_state, [0] * len(plant.inputs), plant.approximate).full()
    )
    values = np.linalg.eigvalsh(matrix + matrix.T)
    return 1 if values.min() > 0 else -1 if values.max() < 0 else 0


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="Lyapunov MRAC", changes={"duration": 3.0, "measure_from": 0.0}),
)
