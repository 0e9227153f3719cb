"""Set-points: values that a run is given while it runs, and a filter, part of the controller's step, that makes a motion of them.

    (d/dt + a)^m y = a^m w       for every coordinate y with its set-point w

It is discretised exactly for a set-point that is held over a cycle, so that motion, velocity and response belong together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NoReturn

import casadi as ca
import numpy as np

from fpirhc.errors import Mistakes, NotSupported
from fpirhc.fields.kinds import Count, Positive
from fpirhc.plant.chain import response_units
from fpirhc.plant.motion import sampling
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, expression, power
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.reference import Reference, Steps, pairs

_GIVEN = "setpoints"  # signal from outside: the set-points in force, then those of the next nodes
_OWN = "_reference_own"  # the filters' state, what is given
FILTER = "reference_filter"  # remembered: the filters' state


@dataclass(frozen=True, eq=False)
class FilterBank:
    """One filter with equal poles per coordinate, (d/dt + a)^m y = a^m w, and the motion of a reference that follows from them.

    With z = (y, y', ..., y^(m-1)), b = (1, 0, ..., 0) and w held, z(t + h) = w b + Phi(h) (z(t) - w b) with Phi(h) =
    e^(-a h) sum_{k<m} (h N)^k / k!; N = A + a I, A the companion matrix of (s + a)^m, is nilpotent. Products and sums round alike
    for numbers and expressions. Source: Franklin, Powell, Workman, Digital Control of Dynamic Systems, 1998, 4.3.3.

    Args:
        rate: of all filters.
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
    def own(self) -> Signal:
        """The signal from which the motion follows: the filters' state, and the set-points."""
        return Signal(_OWN, (*self.elements, *(f"{_GIVEN}.{name}" for name in self.given.elements)))

    def gathered(self, s: Signals) -> Expression:
        """Return the own signal inside a step."""
        return ca.vertcat(getattr(s, FILTER), getattr(s, _GIVEN))

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
        z, points = self._parts(own)
        if ahead:
            phis = [transition(self.rate, ahead, order) for order in self.orders.values()]
            z = [_after_motion(phi, z[k], points[k, 0]) for k, phi in enumerate(phis)]
        state, response = arranged(self.plant, self._chains(z, points[:, 0]))
        results = [ca.densify(state), ca.densify(response)]
        return ca.Function("fpirhc_reference_now", [ca.SX.sym("t"), own], results, ["t", "own"], ["state", "response"])

    def preview(self, times: np.ndarray) -> ca.Function:
        """Function (t, own signal) -> (states (nx, N + 1), responses (n, N + 1)): free motion, every node's set-points held."""
        own = ca.SX.sym("own", self.own.size)
        z, points = self._parts(own)
        lengths = np.round(np.diff(times) / times[1], 12)  # equal stages are equal to the last bit
        phis = {
            n: [transition(self.rate, times[1] * n, order) for order in self.orders.values()] for n in lengths.tolist()
        }
        columns = []
        for node in range(len(times)):
            held = points[:, min(node, self.nodes - 1)]
            columns.append(arranged(self.plant, self._chains(z, held)))
            stage = phis[lengths[min(node, len(lengths) - 1)]]
            z = [_after_motion(phi, z[k], held[k]) for k, phi in enumerate(stage)]
        tables = [ca.densify(ca.horzcat(*parts)) for parts in zip(*columns, strict=True)]
        names = ["t", "own"], ["states", "responses"]
        return ca.Function("fpirhc_reference_preview", [ca.SX.sym("t"), own], tables, *names)

    def _split(self, column: Expression) -> list[Expression]:
        return ca.vertsplit(column, [0, *np.cumsum(list(self.orders.values())).tolist()])

    def _parts(self, own: Expression) -> tuple[list[Expression], Expression]:
        """State of every filter, and set-points (n, nodes), of the own signal."""
        size = len(self.elements)
        points = ca.reshape(own[size:], len(self.orders), self.nodes)
        return self._split(own[:size]), points

    def _chains(self, z: Sequence[Expression], held: Expression) -> list[Expression]:
        """(y, y', ..., y^(m)) of every coordinate; of a map the divided differences."""
        orders = enumerate(self.orders.values())
        return [chain_of(self.plant, self.rate, z[k], held[k], order) for k, order in orders]


def arranged(plant: Plant, chains: Sequence[Expression]) -> tuple[Expression, Expression]:
    """State in the plant's order and response, of (y, y', ..., y^(m)) of every coordinate."""
    by_name = dict(zip(plant.chains, chains, strict=True))
    state = [by_name[e.rstrip("'")][e.count("'")] for e in plant.output.elements]
    response = [by_name[c][r] for c, r in plant.chains.items()]
    return ca.vertcat(*state), ca.vertcat(*response)


_Entry = float | Expression


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
    return ca.exp(value) if isinstance(value, ca.SX | ca.MX) else math.exp(value)


_ON_TIME = 1e-12  # share of a change's time by which a time may be rounded


@dataclass(frozen=True, eq=False)
class Setpoint(Reference):
    """A motion towards set-points: Setpoint({"q1": 0.2, "q2": [(0.0, 1.0), (2.0, 1.5)]}, rate=10.0).

    Args:
        values: set-points by coordinate: a number, or pairs (time, set-point), each in force from its time on. A run may be given
            others (`simulate(..., setpoints=...)`, `Stepper.step(..., setpoints=...)`); what is decided before a run follows these.
        rate: a, the rate of the filter, per unit of time.
        order: m of every coordinate, at least the plant's order; None: the plant's order. With the plant's order the response jumps
            by a^m (w_new - w_old) at a change, with one more it is continuous.
        start: where the filter begins, at rest, by coordinate; the others begin at their first set-point.
        announced: whether a controller with a horizon is also given the set-points of its later nodes.

    Raises:
        InvalidValue: values that are no steps.
        InvalidProblem: a start of a coordinate without set-point.
    """

    values: Mapping[str, Steps]
    rate: Positive = field(metadata={"structure": True})
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
        return self.values

    def function(self, plant: Plant) -> ca.Function:
        """Function t -> (nominal state (nx), nominal response (n)): the filter's motion along `values`.

        Raises:
            InvalidProblem: a coordinate is missing or unknown, or its order is above that of the filter.
        """
        self._check_names(plant)
        t = ca.SX.sym("t")
        chains = [self._along_values(plant, name, m, t) for name, m in self._orders(plant).items()]
        state, response = arranged(plant, chains)
        results = [ca.densify(state), ca.densify(response)]
        return ca.Function("fpirhc_reference", [t], results, ["t"], ["state", "response"])

    def given(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        bank = self._bank(plant, stages)
        first = tuple(pairs(name, self.values[name])[0][1] for name in plant.chains)
        return (replace(bank.given, start=first * bank.nodes),)

    def own(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        return (self._bank(plant, stages).own,)

    def block(self, plant: Plant, stages: int, period: float) -> Block:
        bank, count = self._bank(plant, stages), len(plant.chains)
        motion = bank.motion(0.0)
        rest = {name: self._rest(name) for name in plant.chains}
        start = tuple(rest.get(element, 0.0) for element in bank.elements)
        names, units = tuple(plant.chains), plant.output.units[:count]

        def step(s: Signals) -> dict[str, Expression]:
            own = bank.gathered(s)
            return {
                "setpoint": getattr(s, bank.given.name)[:count],
                "reference_response": motion(0.0, own)[1],
                bank.own.name: own,
                f"{FILTER}_next": bank.advanced(s, period),
            }

        shown = Signal("setpoint", names, units), Signal("reference_response", names, response_units(plant))
        memory = Layout((Signal(FILTER, bank.elements, start=start),))
        return Block("set_points", Layout((bank.given,)), Layout((*shown, bank.own)), step, memory)

    def motion_now(self, plant: Plant, stages: int, ahead: float = 0.0) -> ca.Function:
        """Function (t, own signal) -> (state, response), now or after some time with the set-points held."""
        return self._bank(plant, stages).motion(ahead)

    def preview(self, plant: Plant, nodes: np.ndarray) -> ca.Function:
        """Function (t, own signal) -> (states (nx, N + 1), responses (n, N + 1)) at the nodes of a horizon."""
        return self._bank(plant, len(nodes) - 1).preview(nodes)

    def largest_jump(self, plant: Plant) -> float:
        jumps: dict[float, list[float]] = {}
        for name in plant.controlled_names:
            order = plant.chains[name]
            if self._orders(plant)[name] == order:
                for time, change in self._changes(name):
                    jumps.setdefault(time, []).append(self._jump(plant, order) * change)
        return max((float(np.linalg.norm(together)) for together in jumps.values()), default=0.0)

    def _jump(self, plant: Plant, order: int) -> float:
        """Jump of the response at a set-point that changes by one."""
        return float(ca.evalf(chain_of(plant, self.rate, ca.SX.zeros(order), ca.SX(1.0), order))[-1])

    def _bank(self, plant: Plant, stages: int) -> FilterBank:
        return FilterBank(plant, self._orders(plant), self.rate, stages + 1 if self.announced else 1)

    def _orders(self, plant: Plant) -> dict[str, int]:
        """Order of the filter of every coordinate."""
        return {c: self.order or r for c, r in plant.chains.items()}

    def _rest(self, name: str) -> float:
        """Where the filter of a coordinate begins."""
        return float(self.start.get(name, pairs(name, self.values[name])[0][1]))

    def _changes(self, name: str) -> list[tuple[float, float]]:
        """Times and sizes of the changes of one set-point."""
        steps = pairs(name, self.values[name])
        before = [self._rest(name), *(value for _, value in steps[:-1])]
        return [(time, value - old) for (time, value), old in zip(steps, before, strict=True) if value != old]

    def _along_values(self, plant: Plant, name: str, order: int, t: Expression) -> Expression:
        """(y, y', ..., y^(m)) of one coordinate along `values`: a sum of step responses."""
        rate, rest = self.rate, self._rest(name)
        z, held = [expression(ca.SX(rest)), *[expression(ca.SX(0))] * (order - 1)], expression(ca.SX(rest))
        for time, change in self._changes(name):
            phi = transition(rate, ca.fmax(t - time, 0), order)
            z = [entry + change * ((1.0 if k == 0 else 0.0) - phi[k][0]) for k, entry in enumerate(z)]
            held = held + change * (t >= time * (1 - _ON_TIME))
        column = ca.vertcat(*z)
        return chain_of(plant, rate, column, held, order)

    def _check_names(self, plant: Plant) -> None:
        mistakes = Mistakes("reference")
        mistakes.unknown("coordinate", self.values, plant.chains)
        for name, order in plant.chains.items():
            if name not in self.values:
                mistakes.add(f"coordinate '{name}' has no set-point; add '{name}' to Setpoint(values=...)")
            if self.order is not None and self.order < order:
                mistakes.add(
                    f"Setpoint(order={self.order}) is below the order {order} of '{name}', whose motion would jump; leave order out"
                )
        mistakes.raise_if_any()


_LATE = 1e-9  # share of a cycle by which a time may be rounded


def in_force(steps: Sequence[tuple[float, float]], times: np.ndarray, period: float) -> np.ndarray:
    """Return the set-point at some times: a change counts from the first cycle at or after its time."""
    begins = np.array([time for time, _ in steps])
    values = np.array([value for _, value in steps])
    return values[np.searchsorted(begins, times + _LATE * period, side="right") - 1]
