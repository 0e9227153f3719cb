"""Sliding mode control with a boundary layer, on the inverse of the model: a high gain instead of an iteration.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import closing_blocks, reference_block
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import OfDerivatives
from fpirhc.controllers.rivals.reference_model import decay_gains
from fpirhc.errors import Mistakes
from fpirhc.fields.kinds import Positive
from fpirhc.members import Example
from fpirhc.plant.maps import check_modes
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay, rename
from fpirhc.symbolic.expression import Signals, power
from fpirhc.symbolic.layout import Expression, Layout, like, vector
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import error_chains


@dataclass(frozen=True)
class SlidingMode(OfDerivatives):
    """Inverse dynamics with the switching term K tanh(S / w).

    Args:
        rate: Lambda, decay of the error on S = 0, 1/s.
        gain: K, above the largest response error of the model, in units of the response (m/s^2 for n = 2).
        width: w, boundary layer, in units of the response times s (m/s for n = 2); K period / w must stay below 2.
    """

    rate: Positive
    gain: Positive
    width: Positive

    def check(self, problem: Problem) -> None:
        """Raise if the loop chatters even with an exact model.

        Raises:
            InvalidProblem: K period / w is 2 or more.
            NotSupported: an output of order 0.
            InvalidValue: an error on the surface that does not decay in the steps of a map.
        """
        super().check(problem)
        mistakes, product = Mistakes("SlidingMode"), self.gain * problem.period / self.width
        if product >= 2:
            mistakes.add(
                f"gain x period / width = {product:.3g} chatters with any model; "
                f"take a width above {0.5 * self.gain * problem.period:.3g} "
                f"or a gain below {2 * self.width / problem.period:.3g}"
            )
        mistakes.raise_if_any()
        for order in problem.plant.response_orders.values():
            check_modes(self, problem.plant, decay_gains(self.rate, order - 1))

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        response = built.plant.response_signal("_reference_response")
        closing, delays = closing_blocks(built, self.deformation)
        blocks = [
            reference_block(built),
            rename("nominal", response, built.plant.response_signal("nominal")),
            self._surface_block(built.plant),
            *closing,
        ]
        return blocks, delays

    def _surface_block(self, plant: Plant) -> Block:
        """Block (state, reference, nominal) -> (S, desired)."""
        units = [f"{unit} {plant.time_unit}" for unit in plant.response_signal("desired").units]

        def step(s: Signals) -> dict[str, Expression]:
            surfaces, drifts = [], []
            for chain in error_chains(plant, s.reference - getattr(s, plant.output.name)):
                degree = len(chain) - 1
                gains = [math.comb(degree, k) * power(self.rate, degree - k) for k in range(degree + 1)]
                surfaces.append(sum(g * e for g, e in zip(gains, chain, strict=True)))
                drifts.append(sum((g * e for g, e in zip(gains, chain[1:], strict=False)), start=0 * chain[0]))
            surface = ca.vertcat(*surfaces)
            switching = self.gain * ca.tanh(surface / self.width)
            return {"surface": surface, "desired": s.nominal + ca.vertcat(*drifts) + switching}

        reads = Layout((plant.output, like(plant.output, "reference"), plant.response_signal("nominal")))
        writes = Layout((vector("surface", plant.controlled_names, units), plant.response_signal("desired")))
        return Block("surface", reads, writes, step)


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="sliding mode", changes={"duration": 3.0, "measure_from": 0.0}),
)
