"""One filter with equal poles per coordinate, and the motion of a plant's reference that follows from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import casadi as ca
import numpy as np

from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Signals
from fpirhc.symbolic.layout import Expression, Signal
from fpirhc.symbolic.live import is_live
from fpirhc.task.equal_poles import Entry, after_motion, differences, highest, transition

GIVEN = "setpoints"  # signal from outside: the set-points in force, then those of the next nodes
OWN = "_reference_own"  # the filters' state, what is given, and a live rate
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
        names = self.plant.names
        later = tuple(f"{name}@{k}" for k in range(1, self.nodes) for name in names)
        units = tuple(self.plant.coordinates[name] for name in names)
        return Signal(GIVEN, (*names, *later), units * self.nodes)

    @property
    def own(self) -> Signal:
        """The signal from which the motion follows: the filters' state, the set-points, and the rate where it is live."""
        rate = ("rate",) if is_live(self.rate) else ()
        return Signal(OWN, (*self.elements, *(f"{GIVEN}.{name}" for name in self.given.elements), *rate))

    def gathered(self, s: Signals) -> Expression:
        """Return the own signal inside a step."""
        rate = [cast(Expression, self.rate)] if is_live(self.rate) else []
        return ca.vertcat(getattr(s, FILTER), getattr(s, GIVEN), *rate)

    def advanced(self, s: Signals, period: float) -> Expression:
        """Return the filters' state one cycle later inside a step, with the set-points held."""
        parts, points = self._split(getattr(s, FILTER)), getattr(s, GIVEN)
        phis = [transition(self.rate, period, order) for order in self.orders.values()]
        return ca.vertcat(
            *(after_motion(phi, z, points[k]) for k, (phi, z) in enumerate(zip(phis, parts, strict=True)))
        )

    def motion(self, ahead: float) -> ca.Function:
        """Function (t, own signal) -> (state, response), now or after some time with the set-points held."""
        own = ca.SX.sym("own", self.own.size)
        z, points, rate = self._parts(own)
        if ahead:
            phis = [transition(rate, ahead, order) for order in self.orders.values()]
            z = [after_motion(phi, z[k], points[k, 0]) for k, phi in enumerate(phis)]
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
            z = [after_motion(phi, z[k], held[k]) for k, phi in enumerate(phis)]
        tables = [ca.densify(ca.horzcat(*parts)) for parts in zip(*columns, strict=True)]
        return ca.Function("fpirhc_reference_preview", [own], tables, ["own"], ["states", "responses"])

    def _split(self, column: Expression) -> list[Expression]:
        return ca.vertsplit(column, [0, *np.cumsum(list(self.orders.values())).tolist()])

    def _parts(self, own: Expression) -> tuple[list[Expression], Expression, Entry]:
        """State of every filter, set-points (n, nodes), and rate, of the own signal."""
        size, count = len(self.elements), self.given.size
        points = ca.reshape(own[size : size + count], len(self.orders), self.nodes)
        return self._split(own[:size]), points, own[size + count] if is_live(self.rate) else self.rate

    def _chains(self, z: Sequence[Expression], held: Expression, rate: Entry) -> list[Expression]:
        """(y, y', ..., y^(m)) of every coordinate; of a map the divided differences."""
        orders = enumerate(self.orders.values())
        if self.plant.step is not None:
            step = self.plant.sampling
            return [ca.vertcat(*differences(rate, step, z[k], held[k], order)) for k, order in orders]
        return [ca.vertcat(z[k], highest(rate, z[k], held[k], order)) for k, order in orders]


def arranged(plant: Plant, chains: Sequence[Expression]) -> tuple[Expression, Expression]:
    """State in the plant's order and response, of (y, y', ..., y^(m)) of every coordinate."""
    by_name = dict(zip(plant.names, chains, strict=True))
    state = [by_name[e.rstrip("'")][e.count("'")] for e in plant.state.elements]
    response = [by_name[c][r] for c, r in zip(plant.names, plant.orders, strict=True)]
    return ca.vertcat(*state), ca.vertcat(*response)
