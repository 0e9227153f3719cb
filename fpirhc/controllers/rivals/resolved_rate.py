"""Resolved acceleration rate control: the law prescribes the rate of the response, and commands change by increments.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import commanding_blocks, invert_block, reference_block
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import OfDerivatives
from fpirhc.controllers.rivals.reference_model import decay_gains
from fpirhc.fields.kinds import Positive
from fpirhc.members import Example
from fpirhc.plant.motion import controlled_places
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, like, scalar
from fpirhc.tracking.base import error_chains


@dataclass(frozen=True)
class ResolvedAccelerationRate(OfDerivatives):
    """Increments of the command with which all modes of the error and its first n derivatives decay as exp(-rate t).

    The first cycle has no measured response yet and prescribes (d/dt + rate)^n e = 0.

    Args:
        rate: Lambda, 1/s.
    """

    rate: Positive

    of_time = True

    def gains(self, degree: int) -> tuple[float, ...]:
        """Return the coefficients of (d/dt + rate)^degree below the highest, lowest derivative first."""
        return decay_gains(self.rate, degree)

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        closing, delays = commanding_blocks(built)
        blocks = [
            reference_block(built),
            _nominal_block(built),
            self._rate_block(built),
            _increment_block(built),
            invert_block(plant),
            *closing,
        ]
        return blocks, delays

    def _rate_block(self, built: Built) -> Block:
        """Block (state, realised, reference now and one cycle later) -> (desired, its change in this cycle)."""
        plant, period, warm_up_cycles = built.plant, built.period, built.warm_up

        def step(s: Signals) -> dict[str, Expression]:
            errors = error_chains(plant, s.reference - getattr(s, plant.output.name))
            change, first = [], []
            for k, chain in enumerate(errors):
                whole = [*chain, s.nominal[k] - s.realised[k]]
                feedback = sum(g * e for g, e in zip(self.gains(len(whole)), whole, strict=True))
                change.append(s._nominal_later[k] - s.nominal[k] + period * feedback)
                first.append(s.nominal[k] + sum(g * e for g, e in zip(self.gains(len(chain)), chain, strict=True)))
            running = s.warm_up > warm_up_cycles - 0.5
            desired = s.realised + ca.vertcat(*change)
            return {"_change": ca.vertcat(*change), "desired": ca.if_else(running, desired, ca.vertcat(*first))}

        names = ("nominal", "_nominal_later", "realised")
        reads = (plant.output, like(plant.output, "reference"), *map(plant.response_signal, names), scalar("warm_up"))
        return Block(
            "rate", Layout(reads), Layout((plant.response_signal("_change"), plant.response_signal("desired"))), step
        )


def _nominal_block(built: Built) -> Block:
    """Block time -> nominal response now and one cycle later."""
    plant, function = built.plant, built.later
    controlled = controlled_places(plant)

    def step(s: Signals) -> dict[str, Expression]:
        later = function(s.time, *built.own_values(s))[1][controlled]
        return {"nominal": s._reference_response, "_nominal_later": later}

    reads = Layout((plant.time, plant.response_signal("_reference_response"), *built.own))
    writes = Layout((plant.response_signal("nominal"), plant.response_signal("_nominal_later")))
    return Block("nominal", reads, writes, step)


def _increment_block(built: Built) -> Block:
    """Block (change, last command, state) -> request: the model's response to the last command plus the change."""
    plant, period, warm_up_cycles = built.plant, built.period, built.warm_up
    x, u, p = plant.symbols()
    measured = ca.SX.sym("f", len(plant.controlled_names))
    response = plant.equations.controlled_response(x, u, p)
    highest = plant.equations.response(x, u, p)
    # The measured responses move the state; the model's response does where nothing is measured.
    orders = dict(zip(plant.names, plant.orders, strict=True))
    for k, (name, order) in enumerate(plant.response_orders.items()):
        if orders.get(name) == order:
            highest[plant.names.index(name)] = measured[k]
    rates = []
    for element in plant.state.elements:
        higher = element + "'"
        inside = higher in plant.state.elements
        rates.append(
            x[plant.state.elements.index(higher)] if inside else highest[plant.names.index(element.rstrip("'"))]
        )
    drift = ca.jtimes(response, x, ca.vertcat(*rates))
    model = ca.Function("fpirhc_drifting", [x, u, p, measured], [response, drift])

    def step(s: Signals) -> dict[str, Expression]:
        now, drifting = model(s.state, s._command_before, s.parameters, s.realised)
        request = now + s._change - period * drifting
        return {"_deformed_unclipped": ca.if_else(s.warm_up > warm_up_cycles - 0.5, request, s.desired)}

    names = ("_change", "desired", "realised")
    reads = (plant.state, like(plant.input, "_command_before"), plant.parameter, *map(plant.response_signal, names))
    writes = Layout((plant.response_signal("_deformed_unclipped"),))
    return Block("increment", Layout((*reads, scalar("warm_up"))), writes, step)


EXAMPLES = (
    Example(problem="mrac_pendulum", controller="acceleration rate", changes={"duration": 3.0, "measure_from": 0.0}),
)
