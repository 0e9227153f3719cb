"""The reference model of model reference adaptive control: a motion from the plant's start to the nominal one.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from fpirhc.plant.maps import step_of
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, expression, power
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.tracking.base import error_chains


def decay_gains(rate: float, order: int) -> tuple[float, ...]:
    """Return the gains of (e, e', ...) in (d/dt + rate)^n e = 0, lowest derivative first."""
    return tuple(math.comb(order, s) * power(rate, order - s) for s in range(order))


def companion(gains: tuple[float, ...]) -> np.ndarray:
    """Return the matrix A of x' = A x for the chain x = (e, e', ...) with e^(n) = -gains . x, shape (n, n)."""
    matrix = np.diag(np.ones(len(gains) - 1), 1)
    matrix[-1] = -np.array(gains)
    return matrix


def model_block(plant: Plant, rate: float, period: float) -> Block:
    """Return Block (state, reference and its response, warm_up) -> 'model', the model's state, and 'nominal', its response.

    Coordinates that are not controlled follow the reference.
    """
    chains = [[name + "'" * s for s in range(order)] for name, order in plant.response_orders.items()]
    gains = [decay_gains(rate, len(chain)) for chain in chains]
    ends_of_steps = np.cumsum([0, *(len(g) ** 2 for g in gains)]).tolist()

    fixed = np.concatenate([step_of(plant, companion(g), period).ravel(order="F") for g in gains])
    memory = Layout((Signal("model_deviation", tuple(e for chain in chains for e in chain)),))
    ends = np.cumsum([0, *(len(chain) for chain in chains)]).tolist()

    def step(s: Signals) -> dict[str, Expression]:
        first = ca.vertcat(
            *(e for chain in error_chains(plant, s.reference - getattr(s, plant.output.name)) for e in chain)
        )
        deviation = ca.vertsplit(ca.if_else(s.warm_up > 0.5, s.model_deviation, first), ends)
        spread = dict(zip(memory.signals[0].elements, ca.vertsplit(ca.vertcat(*deviation)), strict=True))
        lag = ca.vertcat(*(spread.get(e, 0) for e in plant.output.elements))
        pull = [ca.dot(ca.vertcat(*g), d) for g, d in zip(gains, deviation, strict=True)]
        entries = ca.vertsplit(expression(ca.DM(fixed)), ends_of_steps)
        steps = [ca.reshape(m, len(g), len(g)) for m, g in zip(entries, gains, strict=True)]
        deviation_next = [ca.mtimes(m, d) for m, d in zip(steps, deviation, strict=True)]
        return {
            "model": s.reference - lag,
            "nominal": s._reference_response + ca.vertcat(*pull),
            "model_deviation_next": ca.vertcat(*deviation_next),
        }

    reads = (
        plant.output,
        like(plant.output, "reference"),
        plant.response_signal("_reference_response"),
        scalar("warm_up"),
    )
    writes = (like(plant.output, "model"), plant.response_signal("nominal"))
    return Block("reference_model", Layout(reads), Layout(writes), step, memory)
