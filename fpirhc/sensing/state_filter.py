"""State and response from positions alone, by a filter whose own states are the derivatives.

    y_0 = q,   y_j' = w (y_{j-1} - y_j),   j = 1 ... n,      q^(s) seen as w^s sum_i (-1)^i C(s, i) y_{n-s+i}

discretised by the trapezoidal rule, so that constant derivatives are exact. Theory: docs/theory-estimation.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.fields.kinds import Positive
from fpirhc.plant.motion import controlled_places
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Array, OfPositions, spline_weights
from fpirhc.symbolic.block import GAP, Block, is_long
from fpirhc.symbolic.expression import Signals, expression, total
from fpirhc.symbolic.layout import Expression, Layout, Signal

_STAGES, _INPUTS = "filter_stages", "filter_inputs"
_FORGOTTEN = 0.01  # share of a jump after which the filter has settled
_TAIL = 1e-16  # share of a low-pass's weights that is left out


@dataclass(frozen=True)
class StateVariableFilter(OfPositions):
    """Derivatives of filtered positions.

    The filter begins in the steady state of a motion at the plant's first velocities.

    Args:
        bandwidth: w, rad/s.

    References:
        P. C. Young, Process parameter estimation and self adaptive control, in Theory of Self-Adaptive Control Systems,
        Plenum 1966.
    """

    bandwidth: Positive

    def weights(self, order: int, period: float) -> Array:
        """The B-spline of an n-th difference through n low-passes (1 - p) / (1 - p / z), without the negligible tail."""
        from scipy.special import comb  # it takes longer to import than all the rest of a problem

        pole, _ = self._coefficients(period)
        count = math.ceil(math.log(_TAIL) / math.log(abs(pole))) + 10 * order if pole else 1
        after = np.arange(count)
        return np.convolve(
            (1 - pole) ** order * comb(after + order - 1, order - 1) * pole**after, spline_weights(order)
        )

    def delay(self, order: int, period: float) -> float:
        """N p / (1 - p) + (n - 1) / 2, about n / (w T) - 1/2."""
        pole, _ = self._coefficients(period)
        return order * pole / (1 - pole) + (order - 1) / 2

    def fills(self, order: int) -> int:
        del order
        return 1

    def settles(self, order: int, period: float) -> int:
        return int(np.argmax(np.cumsum(self.weights(order, period)) >= 1 - _FORGOTTEN)) + 1

    def block(self, plant: Plant, period: float, start: Array, seen: Signal) -> Block:
        """Block (positions) -> (state, response).

        Over a gap the positions go on by the polynomial of the plant's order whose filtered derivatives are those before it.
        """
        return self._block(plant, period, start, seen, lost=False)

    def _block(self, plant: Plant, period: float, start: Array, seen: Signal, *, lost: bool) -> Block:
        memory = tuple(self._memory(plant, period, start, kind) for kind in (_STAGES, _INPUTS))
        powers = tuple(Signal(f"{m.name}_of_power", m.elements) for m in memory) if lost else ()

        def step(s: Signals) -> dict[str, Expression]:
            positions = ca.vertsplit(getattr(s, seen.name))
            before = [s.filter_stages, s.filter_inputs]
            if lost:
                before = self._moved(
                    plant, period, positions, before, (s.filter_stages_of_power, s.filter_inputs_of_power), s.gap
                )
            chains = self._chains(plant, period, positions, *before)
            known: dict[str, Expression] = {}
            responses: list[Expression] = []
            for (name, order), chain in zip(plant.chains.items(), chains, strict=True):
                known[name] = chain[0]
                known |= {name + "'" * d: self._derivative(chain, order, d) for d in range(1, order)}
                responses.append(self._derivative(chain, order, order))
            return {
                plant.output.name: ca.vertcat(*(known[e] for e in plant.output.elements)),
                "realised": ca.vertcat(*(responses[k] for k in controlled_places(plant))),
                **_remembered(chains, memory),
                **{f"{m.name}_next": expression(ca.DM.zeros(m.size)) for m in powers},
            }

        reads, writes = (
            Layout((seen, GAP) if lost else (seen,)),
            Layout((plant.output, plant.response_signal("realised"))),
        )
        own = Layout((*memory, *powers))
        if lost:
            return Block("estimate", reads, writes, step, own, waits=self._waiting(plant, period, memory, powers))
        return Block(
            "estimate", reads, writes, step, own, bridged=lambda: self._block(plant, period, start, seen, lost=True)
        )

    def _chains(
        self, plant: Plant, period: float, positions: Sequence[Expression], stages: Expression, inputs: Expression
    ) -> list[list[Expression]]:
        """Position and low-passes of every coordinate, one cycle later."""
        keep, new = self._coefficients(period)
        chains, at = [], 0
        for position, order in zip(positions, plant.chains.values(), strict=True):
            chain = [position]
            for j in range(order):
                chain.append(keep * stages[at] + new * (chain[j] + inputs[at]))
                at += 1
            chains.append(chain)
        return chains

    def _ahead(self, plant: Plant, period: float, stages: Expression, inputs: Expression) -> list[Expression]:
        """Positions one cycle after the last ones, on the polynomials that n low-passes show as these derivatives D_s.

        Such a polynomial has the derivatives (1 + D / w)^n D_s = sum_j C(n, j) D_{s+j} / w^j, those beyond D_n being zero.
        """
        positions, at = [], 0
        for order in plant.chains.values():
            chain = [inputs[at], *(stages[at + j] for j in range(order))]
            seen = [self._derivative(chain, order, d) for d in range(1, order + 1)]
            positions.append(chain[0])
            for d in range(1, order + 1):
                true = total(math.comb(order, j) / self.bandwidth**j * seen[d + j - 1] for j in range(order - d + 1))
                positions[-1] += true * period**d / math.factorial(d)
            at += order
        return positions

    def _moved(
        self,
        plant: Plant,
        period: float,
        positions: Sequence[Expression],
        before: Sequence[Expression],
        powers: Sequence[Expression],
        gap: Expression,
    ) -> list[Expression]:
        """Memory of the last cycle, had the positions gone on to now: what the filter answers to a power of the time is added."""
        expected = self._ahead(plant, period, *before)
        away = ca.vertcat(
            *(y - h for y, h, n in zip(positions, expected, plant.chains.values(), strict=True) for _ in range(n))
        )
        now = ca.vertcat(*((gap + 1) ** n for n in plant.chains.values() for _ in range(n)))
        share = [ca.if_else(is_long(gap), 1, one / now) for one in powers]
        return [value + w * away for value, w in zip(before, share, strict=True)]

    def _waiting(self, plant: Plant, period: float, memory: Sequence[Signal], powers: Sequence[Signal]) -> Block:
        """Block of a cycle without a sample: positions go on, and beside them the n-th power of the cycles from zero."""

        def step(s: Signals) -> dict[str, Expression]:
            filtered = s.filter_stages, s.filter_inputs
            later = _remembered(self._chains(plant, period, self._ahead(plant, period, *filtered), *filtered), memory)
            power = [(s.gap + 1) ** n for n in plant.chains.values()]
            rising = self._chains(plant, period, power, s.filter_stages_of_power, s.filter_inputs_of_power)
            later |= _remembered(rising, powers)
            return {k: ca.if_else(is_long(s.gap), getattr(s, k.removesuffix("_next")), v) for k, v in later.items()}

        return Block("estimate_waits", Layout((GAP,)), Layout(), step, Layout((*memory, *powers)))

    def _coefficients(self, period: float) -> tuple[float, float]:
        """Coefficients (keep, new) of y_j(k) = keep y_j(k-1) + new (y_{j-1}(k) + y_{j-1}(k-1))."""
        double = 2 / period
        return (double - self.bandwidth) / (double + self.bandwidth), self.bandwidth / (double + self.bandwidth)

    def _derivative(self, chain: list[Expression], order: int, degree: int) -> Expression:
        terms = ((-1.0) ** i * math.comb(degree, i) * chain[order - degree + i] for i in range(degree + 1))
        return self.bandwidth**degree * total(terms)

    def _memory(self, plant: Plant, period: float, start: Array, kind: str) -> Signal:
        """The stages (or their inputs) one cycle before the first one; stage j is late by j / w."""
        names, values = [], []
        for name, order in plant.chains.items():
            place = start[plant.output.elements.index(name)]
            speed = start[plant.output.elements.index(name + "'")] if order > 1 else 0.0
            late = 1 if kind == _STAGES else 0
            names += [f"{name}@{j + 1}" for j in range(order)]
            values += [float(place - speed * (period + (j + late) / self.bandwidth)) for j in range(order)]
        return Signal(kind, tuple(names), start=tuple(values))


def _remembered(chains: Sequence[Sequence[Expression]], memory: Sequence[Signal]) -> dict[str, Expression]:
    """Stages and inputs of every low-pass, under the names of these signals."""
    stages = ca.vertcat(*(value for chain in chains for value in chain[1:]))
    inputs = ca.vertcat(*(value for chain in chains for value in chain[:-1]))
    return {f"{m.name}_next": value for m, value in zip(memory, (stages, inputs), strict=True)}


EXAMPLES = (StateVariableFilter(bandwidth=100.0),)
