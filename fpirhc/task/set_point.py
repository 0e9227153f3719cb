"""Set-points: values that a run is given while it runs, and a filter that makes a motion of them.

    (d/dt + a)^m y = a^m w       for every coordinate y with its set-point w

The filter is discretised exactly for a set-point that is held over a cycle (see `equal_poles`), so that motion, velocity and response
belong together. It is a part of the controller's step. A horizon sees the free motion of the filter from its state of this cycle,
with the set-point held; announced set-points are held until the node at which they change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NoReturn, cast

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, Mistakes, NotSupported
from fpirhc.fields.kinds import Count, Positive
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.symbolic.live import is_live, nominal
from fpirhc.task.equal_poles import highest, moved, transition
from fpirhc.task.reference import Reference, Steps
from fpirhc.task.steps import pairs

GIVEN = "setpoints"  # signal from outside: the set-points in force, then those of the next nodes
OWN = "_reference_own"  # the filter's state, what is given, and a live rate
_FILTER = "reference_filter"
_ON_TIME = 1e-12  # share of a change's time by which a time may be rounded


@dataclass(frozen=True, eq=False)
class Setpoint(Reference):
    """A motion towards set-points: Setpoint({"q1": 0.2, "q2": [(0.0, 1.0), (2.0, 1.5)]}, rate=10.0).

    Args:
        values: set-points by coordinate: a number, or pairs (time, set-point), each in force from its time on. A run may be given
            others (`simulate(..., setpoints=...)`, `Stepper.step(..., setpoints=...)`); what is decided before a run follows these.
        rate: a, the rate of the filter, per unit of time.
        order: m of every coordinate, at least the plant's order; None: the plant's order. With the plant's order the response jumps by
            a^m (w_new - w_old) at a change, with one more it is continuous.
        start: where the filter begins, at rest, by coordinate; the others begin at their first set-point.
        announced: whether a controller with a horizon is also given the set-points of its later nodes.

    Raises:
        InvalidValue: values that are no steps.
        InvalidProblem: a start of a coordinate without set-point.
    """

    values: Mapping[str, Steps]
    rate: Positive
    order: Count | None = None
    start: Mapping[str, float] = field(default_factory=dict)
    announced: bool = False

    def __post_init__(self) -> None:
        for name, steps in self.values.items():
            pairs(name, steps)
        mistakes = Mistakes("Setpoint")
        mistakes.unknown("start: coordinate", self.start, self.values)
        mistakes.raise_if_any()

    def coordinates(self, t: Expression) -> NoReturn:
        """Refuse: the motion depends on the orders of a plant; use `function`.

        Raises:
            NotSupported: always.
        """
        del t
        raise NotSupported(
            "the motion towards set-points depends on the orders of a plant; use Setpoint.function(plant)"
        )

    @property
    def set_points(self) -> Mapping[str, Steps]:
        """The set-points of a run that is given no others."""
        return self.values

    def function(self, plant: Plant) -> ca.Function:
        """Function t -> (nominal state (nx), nominal response (n)): the filter's motion along `values`.

        Raises:
            InvalidProblem: a coordinate is missing or unknown, or its order is above that of the filter.
        """
        plant = plant.face
        self._check_names(plant)
        t = ca.SX.sym("t")
        chains = [self._nominal_chain(name, order, t) for name, order in self._orders(plant).items()]
        return self._motion_of(plant, [t], chains, "fpirhc_reference")

    def given(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        """Return the signal of the set-points in force; announced ones of the next nodes follow node by node, 'q1@1'."""
        later = range(1, stages + 1) if self.announced else ()
        names = (*plant.names, *(f"{name}@{k}" for k in later for name in plant.names))
        units = tuple(plant.coordinates[name] for name in plant.names) * (len(later) + 1)
        start = tuple(self._first(name) for name in plant.names) * (len(later) + 1)
        return (Signal(GIVEN, names, units, start),)

    def own(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        """Return one signal with the filter's state, what is given, and the rate where it is live."""
        given = self.given(plant, stages)[0].elements
        rate = ("rate",) if is_live(self.rate) else ()
        return (Signal(OWN, (*self._filter_elements(plant), *(f"{GIVEN}.{name}" for name in given), *rate)),)

    def block(self, plant: Plant, stages: int, period: float) -> Block:
        """Return the block of the filter, which also logs the set-points in force and the response of the reference."""
        orders, given = self._orders(plant), self.given(plant, stages)
        motion, count = self.motion_now(plant, stages), len(plant.names)
        phis = [transition(self.rate, period, order) for order in orders.values()]
        remembered = Signal(_FILTER, self._filter_elements(plant), start=tuple(map(float, self._first_state(plant))))

        def step(s: Signals) -> dict[str, Expression]:
            z, points = getattr(s, _FILTER), getattr(s, GIVEN)
            own = ca.vertcat(z, points, *([cast(Expression, self.rate)] if is_live(self.rate) else []))
            parts = _split(z, list(orders.values()))
            z_next = [moved(phi, part, points[k]) for k, (phi, part) in enumerate(zip(phis, parts, strict=True))]
            return {
                "setpoint": points[:count],
                "reference_response": motion(0.0, own)[1],
                OWN: own,
                f"{_FILTER}_next": ca.vertcat(*z_next),
            }

        shown = (
            Signal("setpoint", plant.names, tuple(plant.coordinates[name] for name in plant.names)),
            Signal("reference_response", plant.names, plant.response_units),
        )
        return Block(
            "set_points", Layout(given), Layout((*shown, *self.own(plant, stages))), step, Layout((remembered,))
        )

    def motion_now(self, plant: Plant, stages: int, ahead: float = 0.0) -> ca.Function:
        """Function (t, own signals) -> (state, response), now or after some time with the set-points held."""
        own = ca.SX.sym("own", self.own(plant, stages)[0].size)
        z, points, rate = self._parts(plant, stages, own)
        orders = list(self._orders(plant).values())
        if ahead:
            z = [moved(transition(rate, ahead, m), z[k], points[k, 0]) for k, m in enumerate(orders)]
        chains = [ca.vertcat(z[k], highest(rate, z[k], points[k, 0], m)) for k, m in enumerate(orders)]
        return self._motion_of(plant, [ca.SX.sym("t"), own], chains, "fpirhc_reference_now")

    def chain(self, plant: Plant, stages: int, coordinate: str, order: int) -> ca.Function:
        """Function (t, own signals) -> the coordinate's value and its derivatives up to `order`, shape (order + 1,).

        Raises:
            InvalidProblem: the order is above that of the filter.
        """
        orders, place = self._orders(plant), plant.names.index(coordinate)
        if order > orders[coordinate]:
            raise InvalidProblem(
                f"reference: derivatives of '{coordinate}' are needed up to order {order}, and the filter of its set-point has order "
                f"{orders[coordinate]}; give Setpoint(order={order})"
            )
        own = ca.SX.sym("own", self.own(plant, stages)[0].size)
        z, points, rate = self._parts(plant, stages, own)
        whole = ca.vertcat(z[place], highest(rate, z[place], points[place, 0], orders[coordinate]))
        return ca.Function("fpirhc_reference_chain", [ca.SX.sym("t"), own], [ca.densify(whole[: order + 1])])

    def preview(self, plant: Plant, stages: int, step: float) -> ca.Function:
        """Function (own signals) -> (states (nx, N + 1), responses (n, N + 1)) at the nodes of a horizon."""
        own = ca.SX.sym("own", self.own(plant, stages)[0].size)
        z, points, rate = self._parts(plant, stages, own)
        orders = list(self._orders(plant).values())
        phis = [transition(rate, step, order) for order in orders]
        states, responses = [], []
        for node in range(stages + 1):
            held = points[:, node if points.shape[1] > 1 else 0]
            chains = [ca.vertcat(z[k], highest(rate, z[k], held[k], m)) for k, m in enumerate(orders)]
            state, response = _arranged(plant, chains)
            states.append(state)
            responses.append(response)
            z = [moved(phi, z[k], held[k]) for k, phi in enumerate(phis)]
        tables = [ca.densify(ca.horzcat(*columns)) for columns in (states, responses)]
        return ca.Function("fpirhc_reference_preview", [own], tables, ["own"], ["states", "responses"])

    def rests(self, until: float) -> bool:
        """Return whether no set-point changes up to some time, and the filter begins at the first ones."""
        steps = {name: pairs(name, values) for name, values in self.values.items()}
        still = all(time == 0 or time > until for one in steps.values() for time, _ in one)
        return still and all(value == steps[name][0][1] for name, value in self.start.items())

    def largest_jump(self, plant: Plant) -> float:
        """Largest jump of the controlled responses at a change of `values`; zero with a filter of a higher order than the plant's."""
        jumps = {}
        for k in plant.controlled_indices:
            name, rate = plant.names[k], nominal(self.rate)
            if self._orders(plant)[name] == plant.orders[k]:
                before = float(self.start.get(name, self._first(name)))
                for time, value in pairs(name, self.values[name]):
                    jumps[time, name] = rate ** plant.orders[k] * abs(value - before)
                    before = value
        times = {time for time, _ in jumps}
        return max(
            (float(np.hypot.reduce([j for (t, _), j in jumps.items() if t == time])) for time in times), default=0.0
        )

    def _first(self, name: str) -> float:
        return pairs(name, self.values[name])[0][1]

    def _orders(self, plant: Plant) -> dict[str, int]:
        """Order of the filter of every coordinate."""
        return {c: self.order or r for c, r in zip(plant.names, plant.orders, strict=True)}

    def _filter_elements(self, plant: Plant) -> tuple[str, ...]:
        return tuple(name + "'" * k for name, order in self._orders(plant).items() for k in range(order))

    def _first_state(self, plant: Plant) -> np.ndarray:
        """State of the filter at the start, at rest."""
        rest = {name: float(self.start.get(name, self._first(name))) for name in plant.names}
        return np.array([rest.get(element, 0.0) for element in self._filter_elements(plant)])

    def _parts(
        self, plant: Plant, stages: int, own: Expression
    ) -> tuple[list[Expression], Expression, float | Expression]:
        """State of every coordinate's filter, set-points (n, nodes), and rate, of the own signal."""
        orders, count = list(self._orders(plant).values()), self.given(plant, stages)[0].size
        size = sum(orders)
        points = ca.reshape(own[size : size + count], len(orders), count // len(orders))
        rate = own[size + count] if is_live(self.rate) else self.rate
        return _split(own[:size], orders), points, rate

    def _nominal_chain(self, name: str, order: int, t: Expression) -> Expression:
        """The filter's state and highest derivative along `values`: a sum of step responses."""
        rate = nominal(self.rate)
        before = float(self.start.get(name, self._first(name)))
        z, held = [expression(ca.SX(before)), *[expression(ca.SX(0))] * (order - 1)], expression(ca.SX(before))
        for time, value in pairs(name, self.values[name]):
            change, before = value - before, value
            if change:
                phi = transition(rate, ca.fmax(t - time, 0), order)
                z = [entry + change * ((1.0 if k == 0 else 0.0) - phi[k][0]) for k, entry in enumerate(z)]
                held = held + change * (t >= time * (1 - _ON_TIME))
        column = ca.vertcat(*z)
        return ca.vertcat(column, highest(rate, column, held, order))

    def _motion_of(self, plant: Plant, arguments: list[Expression], chains: list[Expression], name: str) -> ca.Function:
        state, response = _arranged(plant, chains)
        results = [ca.densify(state), ca.densify(response)]
        names = ["t", "own"][: len(arguments)]
        return ca.Function(name, arguments, results, names, ["state", "response"])

    def _check_names(self, plant: Plant) -> None:
        mistakes = Mistakes("reference")
        mistakes.unknown("coordinate", self.values, plant.coordinates)
        for name, order in zip(plant.names, plant.orders, strict=True):
            if name not in self.values:
                mistakes.add(f"coordinate '{name}' has no set-point; add '{name}' to Setpoint(values=...)")
            if self.order is not None and self.order < order:
                mistakes.add(
                    f"Setpoint(order={self.order}) is below the order {order} of '{name}', whose motion would jump; leave order out"
                )
        mistakes.raise_if_any()


def _split(column: Expression, sizes: list[int]) -> list[Expression]:
    return ca.vertsplit(column, [0, *np.cumsum(sizes).tolist()])


def _arranged(plant: Plant, chains: list[Expression]) -> tuple[Expression, Expression]:
    """State in the plant's order and response, of (y, y', ..., y^(m)) of every coordinate."""
    by_name = dict(zip(plant.names, chains, strict=True))
    state = [by_name[e.rstrip("'")][e.count("'")] for e in plant.state.elements]
    response = [by_name[c][r] for c, r in zip(plant.names, plant.orders, strict=True)]
    return ca.vertcat(*state), ca.vertcat(*response)
