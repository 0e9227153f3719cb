"""Power-law decay of the tracking error by a derivative of fractional order, for any relative order.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.kinds import Positive, Range
from fpirhc.plant.maps import check_modes
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.tracking.base import ROOM, IntegralLaw, Useful, decay_gains, error_chains, law_signals, own_errors

MOST = 20_000  # cycles of memory: the memory has a fixed size
_REACH = 20.0  # memory x rate by default


_ORDERS = Range(
    "a number between 0 and 2: below 1 decays without overshoot, and from 2 on the error does not decay",
    lambda v: 0 < v < 2,
)


@dataclass(frozen=True)
class Fractional(IntegralLaw):
    """S decays as the Mittag-Leffler function E_beta(-(rate t)^beta).

    At the start of a run the integral of the error is zero, and S_0 is the value of S. Beyond the memory S stops decaying, at about
    S_0 / (1 + gamma(1 - beta) (rate memory)^beta). That is an offset of e_int; e itself decays to zero.

    Args:
        rate: Lambda, 1/s.
        order: beta, between 0 and 2, both excluded.
        memory: length of the sum, s; at least 1 / rate. None: 20 / rate.
        largest: response of every controlled coordinate; an S with rate |S| beyond ten times of it is not remembered, and the last
            one stands for it. Infinite for no bound. Empty: what the limits of the inputs allow.

    Raises:
        InvalidValue: a rate, order or memory outside its range; when the loop is built, a memory of more than 20 000 cycles.
    """

    rate: Positive
    order: Annotated[float, _ORDERS]
    memory: float | None = None
    largest: Sequence[float] = ()

    def __post_init__(self) -> None:
        if self.memory is not None and not 1 <= self.rate * self.memory < math.inf:
            raise InvalidValue(
                f"Fractional(memory={self.memory!r}): expected at least 1 / rate = {1 / self.rate:.4g}; 20 / rate is usual"
            )

    def cycles(self, period: float) -> int:
        """Length L of the memory in control cycles.

        Raises:
            InvalidValue: more than 20 000.
        """
        memory = float(_REACH / self.rate if self.memory is None else self.memory)
        cycles = math.ceil((1 - 1e-9) * memory / period)
        if cycles > MOST:
            raise InvalidValue(
                f"Fractional: a memory of {memory:g} is {cycles} control cycles of {period:g}, more than {MOST}; "
                f"give memory={MOST * period:g} or less"
            )
        return cycles

    def weights(self, cycles: int) -> np.ndarray:
        """Weights w_1 ... w_L of the past, shape (cycles,)."""
        return np.cumprod(1 - (float(self.order) + 1) / np.arange(1, cycles + 1))

    def check(self, plant: Plant, period: float) -> None:  # noqa: ARG002
        """Raise if the error does not decay in the steps of a map."""
        check_modes(self, plant, [self.rate])

    def law(self, plant: Plant, period: float) -> Block:
        """Block (state, target, nominal, warm_up, integral) -> (error to the target, desired, integral in use)."""
        cycles, size = self.cycles(period), len(plant.controlled_names)
        past = tuple(f"{c}@{j}" for c in plant.controlled_names for j in range(1, cycles + 1))
        memory = Layout((Signal("decay_past", past), Signal("decay_first", plant.controlled_names)))
        reads, writes = law_signals(plant)
        column = ca.DM(self._row(cycles, period))

        def step(s: Signals) -> dict[str, Expression]:
            weights, stiffness = column[:cycles], column[cycles]
            error = s._target - getattr(s, plant.output.name)
            errors, running = error_chains(plant, error), s.warm_up > 0.5
            integral = ca.if_else(running, s._integral_before, 0)
            measured, drift = self._decaying(integral, errors)
            last = s.decay_first + ca.vertcat(*(s.decay_past[cycles * k] for k in range(size)))
            decaying = self._useful_decay(measured, ca.if_else(running, last, 0))
            first = ca.if_else(running, s.decay_first, decaying)
            past_now = ca.if_else(running, s.decay_past, 0)
            queues = [_pushed(past_now[cycles * k : cycles * (k + 1)], decaying[k] - first[k]) for k in range(size)]
            # One product per coordinate, so that a long memory becomes a short loop in generated code.
            summed = ca.vertcat(*(ca.dot(weights, queue) for queue in queues))
            next_decaying = -(summed + stiffness * first) / (1 + stiffness)
            return {
                "_target_error": ca.vertcat(*own_errors(plant, error)),
                "desired": s.nominal + drift - (next_decaying - (decaying - first)) / period,
                "_integral_used": integral,
                "decay_past_next": ca.vertcat(*queues),
                "decay_first_next": first,
            }

        return Block("tracking", reads, writes, step, memory, opaque=True)

    def _row(self, cycles: int, period: float) -> np.ndarray:
        """The weights of the past, and (Lambda T)^beta."""
        return np.append(self.weights(cycles), float((self.rate * period) ** self.order))

    def _useful(self, plant: Plant) -> list[Useful]:
        if not self.largest:
            return []
        gains = [(*decay_gains(self.rate, order), 1.0, 0.0)[:2] for order in plant.response_orders.values()]
        return [Useful(self.rate * i, self.rate * e, most) for (i, e), most in zip(gains, self.largest, strict=True)]

    def _useful_decay(self, measured: Expression, last: Expression) -> Expression:
        """S, or the last one where S asks for more than ten times what limits allow: one sample would stay for the whole memory."""
        entries = (
            [
                one if math.isinf(most) else ca.if_else(ca.fabs(self.rate * one) > ROOM * most, before, one)
                for one, before, most in zip(ca.vertsplit(measured), ca.vertsplit(last), self.largest, strict=True)
            ]
            if self.largest
            else ca.vertsplit(measured)
        )
        return ca.vertcat(*entries)

    def _decaying(self, integral: Expression, errors: list[list[Expression]]) -> tuple[Expression, Expression]:
        """S, and its derivative without e^(n)."""
        decaying, drift = [], []
        for k, chain in enumerate(errors):
            gains, whole = decay_gains(self.rate, len(chain)), [integral[k], *chain]
            decaying.append(whole[-1] + sum(g * e for g, e in zip(gains, whole, strict=False)))
            drift.append(sum(g * e for g, e in zip(gains, chain, strict=True)))
        return ca.vertcat(*decaying), ca.vertcat(*drift)


def _pushed(queue: Expression, newest: Expression) -> Expression:
    """The queue with a new first entry and without its last entry."""
    # CasADi's slice [:0] of one entry is that entry and not empty.
    return ca.vertcat(newest, queue[:-1]) if queue.numel() > 1 else newest


EXAMPLES = (Fractional(rate=4.0, order=0.8, memory=2.0), Fractional(rate=4.0, order=1.2, memory=2.0))
