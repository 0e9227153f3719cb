"""Model reference adaptive control by nested errors that decay, with a deformation that realises the highest derivative.

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import Controller, closing_blocks, reference_block
from fpirhc.controllers.built import Built
from fpirhc.controllers.rivals.reference_model import decay_gains, model_block
from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.kinds import Positive
from fpirhc.members import Example
from fpirhc.plant.maps import check_modes
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, like, vector
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import error_chains


@dataclass(frozen=True)
class BacksteppingMRAC(Controller):
    """A reference model followed by nested error variables.

    Args:
        model_rate: rate of the reference model, 1/s.
        rates: k_1 ... k_n, 1/s, one per derivative below the relative order n, the same for all controlled coordinates.
        deformation: the fixed-point map between desired response and request; Identity() is no adaptation.

    Raises:
        InvalidField: a rate that is not positive.
        InvalidValue: no rates.
    """

    model_rate: Positive
    rates: Sequence[Positive]
    deformation: Deformation

    def __post_init__(self) -> None:
        if not self.rates:
            raise InvalidValue(f"BacksteppingMRAC(rates={self.rates!r}): expected positive numbers, 1/s")

    def check(self, problem: Problem) -> None:
        """Raise if the rates do not fit the relative orders.

        Raises:
            InvalidProblem: all mistakes together.
            InvalidValue: an error that does not decay in the steps of a map.
        """
        plant, mistakes = problem.plant, Mistakes("BacksteppingMRAC")
        for name, order in plant.response_orders.items():
            if order != len(self.rates):
                mistakes.add(f"'{name}' has relative order {order}, but rates has {len(self.rates)}")
        mistakes.raise_if_any()
        for gains in (decay_gains(self.model_rate, len(self.rates)), self.nested()[-1][:-1]):
            check_modes(self, plant, gains)

    def nested(self) -> list[list[float]]:
        """Return the nested errors as sums over (e, e', ..., e^(n)), one per row; the law makes the last row zero."""
        size = len(self.rates)
        rows = [[1.0, *[0.0] * size]]
        for i, rate in enumerate(self.rates):
            last, before = rows[i], rows[i - 1] if i else [0.0] * (size + 1)
            rows.append([last[k - 1] + rate * last[k] + before[k] for k in range(size + 1)])
        return rows

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        closing, delays = closing_blocks(built, self.deformation)
        own = model_block(plant, self.model_rate, built.period), self._nested_block(plant)
        return [reference_block(built), *own, *closing], delays

    def _nested_block(self, plant: Plant) -> Block:
        """Block (state, model, response of the model) -> (nested errors, desired)."""
        rows = self.nested()
        names = tuple(f"{c}_{i + 1}" for c in plant.controlled_names for i in range(len(self.rates)))

        def step(s: Signals) -> dict[str, Expression]:
            chains = [ca.vertcat(*chain) for chain in error_chains(plant, s.model - getattr(s, plant.output.name))]
            nested = [ca.vertcat(*(ca.dot(ca.vertcat(*row[:-1]), chain) for row in rows[:-1])) for chain in chains]
            feedback = [ca.dot(ca.vertcat(*rows[-1][:-1]), chain) for chain in chains]
            return {"nested": ca.vertcat(*nested), "desired": s.nominal + ca.vertcat(*feedback)}

        reads = Layout((plant.output, like(plant.output, "model"), plant.response_signal("nominal")))
        return Block("nested", reads, Layout((vector("nested", names), plant.response_signal("desired"))), step)


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="backstepping MRAC", changes={"duration": 3.0, "measure_from": 0.0}),
)
