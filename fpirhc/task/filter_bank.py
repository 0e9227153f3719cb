"""One filter with equal poles per coordinate, (d/dt + a)^m y = a^m w, and the motion of a plant's reference that follows from them.

With z = (y, y', ..., y^(m-1)), b = (1, 0, ..., 0) and w held, z(t + h) = w b + Phi(h) (z(t) - w b) with Phi(h) =
e^(-a h) sum_{k<m} (h N)^k / k!; N = A + a I, A the companion matrix of (s + a)^m, is nilpotent. Products and sums round alike
for numbers, live numbers and expressions. Source: Franklin, Powell, Workman, Digital Control of Dynamic Systems, 1998, 4.3.3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import casadi as ca
import numpy as np

from fpirhc.plant.motion import sampling
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.functions import exp, power
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.symbolic.live import LiveNumber, live_numbers

_GIVEN = "setpoints"  # signal from outside: the set-points in force, then those of the next nodes
_OWN = "_reference_own"  # the filters' state, what is given, and a live rate
FILTER = "reference_filter"  # remembered: the filters' state


@dataclass(frozen=True, eq=False)
class FilterBank:
    """The filters of all coordinates.

    Args:
        plant: with the coordinates.
        orders: of the filter, by coordinate.
        rate: of all filters; it may be live.
        nodes: number of set-points that are given per coordinate: one, or one per node of a horizon.
    """

    plant: Plant
    orders: Mapping[str, int]
    rate: float
    nodes: int

    @cached_property
    def elements(self) -> tuple[str, ...]:
        """Names of the filters' states: y, y', ... of every coordinate."""
        return tuple(name + "'" * k for name, order in self.orders.items() for k in range(order))

    @property
    def given(self) -> Signal:
        """The signal of the set-points, node by node; those of later nodes are named 'q1@1'."""
        names = tuple(self.plant.chains)
        later = tuple(f"{name}@{k}" for k in range(1, self.nodes) for name in names)
        units = self.plant.output.units[: len(names)]
        return Signal(_GIVEN, (*names, *later), units * self.nodes)

    @property
    def _open(self) -> list[LiveNumber]:
        """The rate where it is live: it passes through Functions as an entry of the own signal."""
        return list(live_numbers(self.rate).values())

    @property
    def own(self) -> Signal:
        """The signal from which the motion follows: the filters' state, the set-points, and the rate where it is live."""
        rates = ("rate",) * len(self._open)
        return Signal(_OWN, (*self.elements, *(f"{_GIVEN}.{name}" for name in self.given.elements), *rates))

    def gathered(self, s: Signals) -> Expression:
        """Return the own signal inside a step."""
        return ca.vertcat(getattr(s, FILTER), getattr(s, _GIVEN), *(cast(Expression, rate) for rate in self._open))

    def advanced(self, s: Signals, period: float) -> Expression:
        """Return the filters' state one cycle later inside a step, with the set-points held."""
        parts, points = self._split(getattr(s, FILTER)), getattr(s, _GIVEN)
        phis = [transition(self.rate, period, order) for order in self.orders.values()]
        return ca.vertcat(
            *(_after_motion(phi, z, points[k]) for k, (phi, z) in enumerate(zip(phis, parts, strict=True)))
        )

    def motion(self, ahead: float) -> ca.Function:
        """Function (t, own signal) -> (state, response), now or after some time with the set-points held."""
        own = ca.SX.sym("own", self.own.size)
        z, points, rate = self._parts(own)
        if ahead:
            phis = [transition(rate, ahead, order) for order in self.orders.values()]
            z = [_after_motion(phi, z[k], points[k, 0]) for k, phi in enumerate(phis)]
        state, response = arranged(self.plant, self._chains(z, points[:, 0], rate))
        results = [ca.densify(state), ca.densify(response)]
        return ca.Function("fpirhc_reference_now", [ca.SX.sym("t"), own], results, ["t", "own"], ["state", "response"])

    def chain(self, coordinate: str, order: int) -> ca.Function:
        """Function (t, own signal) -> the coordinate's value and its derivatives up to `order`, shape (order + 1,)."""
        own = ca.SX.sym("own", self.own.size)
        z, points, rate = self._parts(own)
        whole = self._chains(z, points[:, 0], rate)[list(self.orders).index(coordinate)]
        return ca.Function("fpirhc_reference_chain", [ca.SX.sym("t"), own], [ca.densify(whole[: order + 1])])

    def preview(self, stages: int, step: float) -> ca.Function:
        """Function (own signal) -> (states (nx, N + 1), responses (n, N + 1)): free motion, the set-points of every node held."""
        own = ca.SX.sym("own", self.own.size)
        z, points, rate = self._parts(own)
        phis = [transition(rate, step, order) for order in self.orders.values()]
        columns = []
        for node in range(stages + 1):
            held = points[:, min(node, self.nodes - 1)]
            columns.append(arranged(self.plant, self._chains(z, held, rate)))
            z = [_after_motion(phi, z[k], held[k]) for k, phi in enumerate(phis)]
        tables = [ca.densify(ca.horzcat(*parts)) for parts in zip(*columns, strict=True)]
        return ca.Function("fpirhc_reference_preview", [own], tables, ["own"], ["states", "responses"])

    def _split(self, column: Expression) -> list[Expression]:
        return ca.vertsplit(column, [0, *np.cumsum(list(self.orders.values())).tolist()])

    def _parts(self, own: Expression) -> tuple[list[Expression], Expression, _Entry]:
        """State of every filter, set-points (n, nodes), and rate, of the own signal."""
        size, count = len(self.elements), self.given.size
        points = ca.reshape(own[size : size + count], len(self.orders), self.nodes)
        rates: list[_Entry] = [own[size + count] for _ in self._open]
        return self._split(own[:size]), points, (rates or [self.rate])[0]

    def _chains(self, z: Sequence[Expression], held: Expression, rate: _Entry) -> list[Expression]:
        """(y, y', ..., y^(m)) of every coordinate; of a map the divided differences."""
        orders = enumerate(self.orders.values())
        return [chain_of(self.plant, rate, z[k], held[k], order) for k, order in orders]


def arranged(plant: Plant, chains: Sequence[Expression]) -> tuple[Expression, Expression]:
    """State in the plant's order and response, of (y, y', ..., y^(m)) of every coordinate."""
    by_name = dict(zip(plant.chains, chains, strict=True))
    state = [by_name[e.rstrip("'")][e.count("'")] for e in plant.output.elements]
    response = [by_name[c][r] for c, r in plant.chains.items()]
    return ca.vertcat(*state), ca.vertcat(*response)


_Entry = float | Expression  # a number, a live number or an expression


def transition(rate: _Entry, time: _Entry, order: int) -> list[list[_Entry]]:
    """Return Phi(time) row by row, shape (order, order)."""
    nilpotent = _nilpotent(rate, order)
    term, terms = _identity(order), _identity(order)
    for k in range(1, order):
        term = [[entry * time / k for entry in row] for row in _product(term, nilpotent)]
        terms = [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(terms, term, strict=True)]
    decay = _exp(-(rate * time))
    return [[decay * entry for entry in row] for row in terms]


def _after_motion(phi: Sequence[Sequence[_Entry]], z: Expression, held: Expression) -> Expression:
    """Return z after the motion with the transition Phi while w = `held`."""
    apart = [z[0] - held, *(z[k] for k in range(1, len(phi)))]
    # At rest every difference is exactly zero, and so z stays exactly where it is.
    rows = [sum(entry * a for entry, a in zip(row, apart, strict=True)) for row in phi]
    return ca.vertcat(held + rows[0], *rows[1:])


def chain_of(plant: Plant, rate: _Entry, z: Expression, held: Expression, order: int) -> Expression:
    """Return (y, y', ..., y^(m)) of a filter in the state z, for w = `held`; of a map the divided differences."""
    if plant.step is not None:
        return ca.vertcat(*differences(rate, sampling(plant), z, held, order))
    return ca.vertcat(z, highest(rate, z, held, order))


def highest(rate: _Entry, z: Expression, held: Expression, order: int) -> Expression:
    """Return y^(m) for w = `held`."""
    value = power(rate, order) * (held - z[0])
    for j in range(1, order):
        value = value - math.comb(order, j) * power(rate, order - j) * z[j]
    return value


def differences(rate: _Entry, step: float, z: Expression, held: Expression, order: int) -> list[Expression]:
    """Return y and its divided forward differences over steps of a map, up to the order m, for w = `held`.

    With the distance d = z - w b they are the first entries of ((Phi(T) - I) / T)^j d.
    """
    phi = transition(rate, step, order)
    apart, values = [z[0] - held, *(z[k] for k in range(1, order))], [z[0]]
    for _ in range(order):
        later = [sum(entry * a for entry, a in zip(row, apart, strict=True)) for row in phi]
        apart = [(after - before) / step for after, before in zip(later, apart, strict=True)]
        values.append(apart[0])
    return values


def _nilpotent(rate: _Entry, order: int) -> list[list[_Entry]]:
    """N = A + a I."""
    rows: list[list[_Entry]] = [[0.0] * order for _ in range(order)]
    for k in range(order):
        if k + 1 < order:
            rows[k][k + 1] = 1.0
        rows[k][k] = rows[k][k] + rate
    for j in range(order):
        rows[-1][j] = rows[-1][j] - math.comb(order, j) * power(rate, order - j)
    return rows


def _identity(order: int) -> list[list[_Entry]]:
    return [[1.0 if j == k else 0.0 for j in range(order)] for k in range(order)]


def _product(left: list[list[_Entry]], right: list[list[_Entry]]) -> list[list[_Entry]]:
    columns = list(zip(*right, strict=True))
    return [[sum(a * b for a, b in zip(row, column, strict=True)) for column in columns] for row in left]


def _exp(value: _Entry) -> _Entry:
    return ca.exp(value) if isinstance(value, ca.SX | ca.MX) else exp(value)
