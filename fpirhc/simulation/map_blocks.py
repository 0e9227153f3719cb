"""The true response of a map in the loop: the divided difference of its outputs over the last cycles.

    realised_k = delta^r y_{k-r} = sum_j (-1)^j C(r, j) y_{k-j} / T^r,

which is the response to the command of r cycles ago. Before cycle r there is none, and it is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from fpirhc.sensing.base import backward_difference, combine
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, Value, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.problem import Problem

_PAST, _FULL = "_outputs_past", "_outputs_known"


def with_true_response(problem: Problem, sense: Block, motion: Signal, response: Signal) -> Block:
    """Return the block of the true motion, with the true response of a map in place of the one that it writes.

    Args:
        problem: with a map.
        sense: block that writes `motion` and `response`.
        motion: signal of the state, or of the outputs where the plant has some.
        response: signal of the response.
    """
    face, period = problem.plant.face, problem.period
    orders = problem.plant.response_orders
    if not any(orders.values()):
        return sense  # a response of order 0 is the output, and no difference
    places = {c: face.state.elements.index(c) for c in orders}
    entries = [(c, j) for c, order in orders.items() for j in range(1, order + 1)]
    past = Signal(_PAST, tuple(f"{c}@{j}" for c, j in entries))
    known = Signal(_FULL)

    def step(s: Signals) -> dict[str, Value]:
        values = dict(sense.step(s))
        before = dict(zip(entries, ca.vertsplit(getattr(s, _PAST)), strict=True))
        now = expression(values[motion.name])
        samples = {c: [now[k], *(before[c, j] for j in range(1, orders[c] + 1))] for c, k in places.items()}
        enough = getattr(s, _FULL)
        values[response.name] = ca.vertcat(
            *(
                ca.if_else(enough > order - 0.5, _difference(samples[c], order) / period**order, 0)
                for c, order in orders.items()
            )
        )
        values[f"{_PAST}_next"] = ca.vertcat(*(samples[c][j - 1] for c, j in entries))
        values[f"{_FULL}_next"] = ca.fmin(enough + 1, max(orders.values()))
        return values

    return replace(sense, step=step, memory=sense.memory + Layout((past, known)))


def _difference(samples: Sequence[Expression], order: int) -> Expression:
    return combine(backward_difference(order), samples)
