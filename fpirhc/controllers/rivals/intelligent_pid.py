"""Intelligent PID of model-free control: an ultra-local model y^(n) = F + alpha u, whose F is estimated over a short window.

    F_k = d^n/dt^n of y less alpha u, by weights over the last L cycles,        u_k = (q^Des_k - F_k) / alpha.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.controllers.base import law_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import Undeformed
from fpirhc.errors import Mistakes
from fpirhc.fields.kinds import Few, finite_number
from fpirhc.members import Example
from fpirhc.plant.maps import step_of
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking, own_errors


@dataclass(frozen=True, eq=False)
class IntelligentPID(Undeformed):
    """The desired response through an ultra-local model, input k for controlled coordinate k.

    Args:
        tracking: the law that gives the desired response.
        alpha: controlled coordinate -> response per unit of its input, of the sign of the plant's.
        window: L, in control cycles, at least the relative order.
    """

    tracking: Tracking
    alpha: Mapping[str, float]
    window: Few

    def check(self, problem: Problem) -> None:
        """Raise if the numbers do not fit the plant.

        Raises:
            InvalidProblem: an unknown or missing coordinate, a gain of zero, an output of order 0, a window that is too short.
        """
        mistakes, orders = Mistakes("IntelligentPID"), problem.plant.response_orders
        mistakes.unknown("alpha: controlled coordinate", self.alpha, problem.plant.controlled_names)
        for name, order in orders.items():
            value = self.alpha.get(name)
            if value is None:
                mistakes.add(f"alpha: controlled coordinate '{name}' has no gain; add '{name}': ...")
            elif not finite_number(value) or value == 0:
                mistakes.add(f"alpha: the gain of '{name}' must be a finite number other than zero, got {value!r}")
            if not 1 <= order <= self.window:
                mistakes.add(
                    f"window = {self.window} cycles: '{name}' has order {order}; it needs an order from 1 to the window"
                )
        mistakes.raise_if_any()

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return law_blocks(built, self.tracking, self._model_block(built))

    def _model_block(self, built: Built) -> Block:
        """Block (outputs, last command, desired) -> (command, F); F is the last one until the window is full, at first zero."""
        plant, length = built.plant, self.window
        names, size = plant.controlled_names, len(plant.controlled_names)
        weights = [window_weights(plant, order, length, built.period) for order in plant.response_orders.values()]
        alpha, response = ca.vertcat(*(self.alpha[n] for n in names)), plant.equations.controlled_response
        places = tuple(f"{name}@{k}" for k in range(length) for name in names)
        memory = Layout((Signal("window_outputs", places), Signal("window_commands", places)))
        memory = memory + Layout((plant.response_signal("ultra_local_before"), scalar("window_filled")))

        def step(s: Signals) -> dict[str, Expression]:
            output = ca.vertcat(*own_errors(plant, getattr(s, plant.output.name)))
            outputs = ca.vertcat(output, s.window_outputs)
            commands = ca.vertcat(s._command_before, s.window_commands[: size * (length - 1)] if length > 1 else [])
            estimates = [
                ca.dot(ca.DM(of_output), outputs[k::size]) - alpha[k] * ca.dot(ca.DM(of_input), commands[k::size])
                for k, (of_output, of_input) in enumerate(weights)
            ]
            full = s.window_filled > length - 0.5
            estimate = ca.if_else(full, ca.vertcat(*estimates), s.ultra_local_before)
            command = (s.desired - estimate) / alpha
            usable = is_finite(ca.vertcat(outputs, estimate))
            after = {
                "window_outputs": outputs[: size * length],
                "window_commands": commands,
                "ultra_local_before": estimate,
            }
            return {
                "command_unclipped": command,
                "_deformed_unclipped": response(s.state, command, s.parameters),
                "ultra_local": estimate,
                **{f"{n}_next": ca.if_else(usable, value, getattr(s, n)) for n, value in after.items()},
                "window_filled_next": ca.if_else(usable, ca.fmin(s.window_filled + 1, length), 0),
            }

        measured = dict.fromkeys((plant.state, plant.output))
        reads = (*measured, built.before, plant.response_signal("desired"), plant.parameter)
        writes = ("_deformed_unclipped", "ultra_local")
        signals = Layout((like(plant.input, "command_unclipped"), *map(plant.response_signal, writes)))
        return Block("ultra_local_model", Layout(reads), signals, step, memory)


def window_weights(plant: Plant, order: int, length: int, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of outputs, shape (length + 1,), and of held inputs, shape (length,), newest first.

    Those of the outputs give the derivative of that order of the least-squares polynomial of that degree; those of the inputs are
    what a held input contributes to it through as many integrators.
    """
    times = np.arange(length, -1, -1) * period
    polynomials = np.vander(times - times.mean(), order + 1)
    outputs = math.factorial(order) * np.linalg.pinv(polynomials)[0]
    chain = step_of(plant, np.eye(order + 1, k=1), period)  # (y, y', ..., held input) one cycle later
    powers = [np.linalg.matrix_power(chain[:order, :order], k) for k in range(length)]
    # y after a pulse of one cycle, by its age.
    pulse = np.array([0.0, *((m @ chain[:order, order])[0] for m in powers)])
    inputs = np.array([sum(outputs[j] * pulse[m - j + 1] for j in range(m + 1)) for m in range(length)])
    return outputs, inputs


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="intelligent PD", changes={"duration": 3.0, "measure_from": 0.0}),
)
