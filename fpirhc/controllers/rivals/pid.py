"""PID control, without any model: one input per controlled coordinate. Theory: docs/theory.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from fpirhc.controllers.base import closing_blocks, nominal_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import Undeformed
from fpirhc.errors import Mistakes
from fpirhc.fields.kinds import finite_number
from fpirhc.members import Example
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay, fed, rename
from fpirhc.symbolic.expression import Signals, total
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar, vector
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import (
    Useful,
    error_chains,
    error_signal,
    integral_delay,
    integral_signal,
    integral_update,
    own_errors,
)


@dataclass(frozen=True, eq=False)
class PID(Undeformed):
    """One PID loop per controlled coordinate.

    Args:
        proportional: k_p of every controlled coordinate by name, in units of the input per unit of the coordinate.
        integral: k_i by name, in the unit of k_p per s; 0 for a coordinate that is not named.
        derivative: gain of e', or gains of (e', e'', ...), by name; at most one less than the relative order.
        bumpless: whether the integral starts where the first command is zero (needs k_i).
    """

    proportional: Mapping[str, float]
    integral: Mapping[str, float] = field(default_factory=dict)
    derivative: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    bumpless: bool = True

    def gains(self, name: str, order: int) -> tuple[float, ...]:
        """Return the gains of (e_int, e, e', ...) of a coordinate of that relative order, shape (order + 1,)."""
        derivative = self.derivative.get(name, ())
        higher = list(derivative) if isinstance(derivative, Sequence) else [derivative]
        padded = [*higher, *[0.0] * (order - 1 - len(higher))]
        return (self.integral.get(name, 0.0), self.proportional[name], *padded)

    def check(self, problem: Problem) -> None:
        """Raise if the gains do not fit the plant."""
        plant, mistakes = problem.plant, Mistakes("PID")
        names = plant.controlled_names
        for what in ("proportional", "integral", "derivative"):
            mistakes.unknown(f"{what}: controlled coordinate", getattr(self, what), names)
        for name in names:
            if name not in self.proportional:
                mistakes.add(f"proportional: controlled coordinate '{name}' has no gain; add '{name}': ...")
        mistakes.raise_if_any()
        at_start = plant.equations.input_gain(problem.start_state, problem.inputs_before, plant.approximate)
        for k, (name, order) in enumerate(plant.response_orders.items()):
            gains = self.gains(name, order)
            if len(gains) > max(order, 1) + 1:
                mistakes.add(
                    f"derivative: '{name}' of relative order {order} has at most {max(order - 1, 0)} gains of e', e'', ..."
                )
            if not all(finite_number(g) for g in gains):
                mistakes.add(f"the gains of '{name}' must be finite numbers, got {gains!r}")
            elif float(at_start[k, k]) * self.proportional[name] <= 0:
                mistakes.add(
                    f"input '{plant.input.elements[k]}' moves '{name}' by {float(at_start[k, k]):.3g} per unit at the start: "
                    f"proportional = {self.proportional[name]:g} does not bring it back; pair inputs and coordinates in order"
                )
        mistakes.raise_if_any()

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        response = plant.response_signal("_reference_response")
        closing, delays = closing_blocks(built)
        blocks = [
            *nominal_blocks(built),
            rename("desired", response, plant.response_signal("desired")),
            self._law(built),
            *closing,
            self._cut_off_block(plant),
            fed(integral_update(plant, built.period, self._useful(built)), "_cut_off", _cut_off(plant)),
        ]
        return blocks, [*delays, *integral_delay(plant)]

    def _useful(self, built: Built) -> list[Useful]:
        """What the integrals may ask for: commands inside the limits of their inputs, by those of the build."""
        sizes = np.fmax(*map(np.abs, built.problem.limits.input_bounds(built.plant)))
        names = built.plant.controlled_names
        return [
            Useful(self.integral.get(n, 0.0), self.proportional[n], float(size) if size > 0 else math.inf)
            for n, size in zip(names, sizes, strict=False)
        ]

    def _cut_off_block(self, plant: Plant) -> Block:
        """Block (command before and after its limits) -> what they cut off in every loop, with the sign of the error's share.

        Without a model the response that is cut off is not known, but every loop has its own input.
        """
        gains = ca.vertcat(*(self.integral.get(name, 0.0) for name in plant.controlled_names))

        def step(s: Signals) -> dict[str, Expression]:
            return {_CUT_OFF: gains * (s.command_unclipped - s.command)}

        return Block(
            "cut_off", Layout((like(plant.input, "command_unclipped"), plant.input)), Layout((_cut_off(plant),)), step
        )

    def _law(self, built: Built) -> Block:
        """Block (state, reference, integral, warm_up) -> command, and the model's response to it (for readers of a log)."""
        plant, seen = built.plant, built.plant.output
        gains = [self.gains(name, order) for name, order in plant.response_orders.items()]

        def step(s: Signals) -> dict[str, Expression]:
            away = s.reference - getattr(s, seen.name)
            own = own_errors(plant, away)
            # An output of order 0 has no chain, but an error.
            errors = [chain or [e] for chain, e in zip(error_chains(plant, away), own, strict=True)]
            direct = [
                total(g * e for g, e in zip(k[1:], chain, strict=True)) for k, chain in zip(gains, errors, strict=True)
            ]
            # The integral with which the first command is zero; without its gain, which may be open, there is none.
            known = [ca.SX(k[0]) if self.bumpless else ca.SX(0) for k in gains]
            starts = [ca.if_else(k == 0, 0, -d / k) for k, d in zip(known, direct, strict=True)]
            integral = ca.if_else(s.warm_up > 0.5, s._integral_before, ca.vertcat(*starts))
            command = ca.vertcat(*(k[0] * integral[i] + d for i, (k, d) in enumerate(zip(gains, direct, strict=True))))
            return {
                "_target_error": ca.vertcat(*own),
                "_integral_used": integral,
                "command_unclipped": command,
                "_deformed_unclipped": plant.equations.controlled_response(s.state, command, s.parameters),
            }

        before, in_use = integral_signal(plant, "_integral_before"), integral_signal(plant, "_integral_used")
        reads = (*plant.motion, like(seen, "reference"), plant.parameter, scalar("warm_up"), before)
        writes = (
            error_signal(plant),
            in_use,
            like(plant.input, "command_unclipped"),
            plant.response_signal("_deformed_unclipped"),
        )
        return Block("pid", Layout(reads), Layout(writes), step)


_CUT_OFF = "_command_cut_off"


def _cut_off(plant: Plant) -> Signal:
    return vector(_CUT_OFF, plant.controlled_names)


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="PID", changes={"duration": 3.0, "measure_from": 0.0}, left=0.25),
)
