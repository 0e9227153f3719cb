"""Set-points: values that a run is given while it runs, and a filter that makes a motion of them.

    (d/dt + a)^m y = a^m w       for every coordinate y with its set-point w

The filter is discretised exactly for a set-point that is held over a cycle (see `equal_poles`), so that motion, velocity and
response belong together. It is a part of the controller's step. A horizon sees the free motion of the filter from its state of this
cycle, with the set-point held; announced set-points are held until the node at which they change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NoReturn

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, Mistakes, NotSupported
from fpirhc.fields.kinds import Count, Positive
from fpirhc.plant.chain import response_units
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.symbolic.live import nominal
from fpirhc.task.filter_bank import FILTER, FilterBank, arranged, chain_of, transition
from fpirhc.task.reference import Reference, Steps
from fpirhc.task.steps import pairs

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
        self._check_names(plant)
        t = ca.SX.sym("t")
        chains = [self._along_values(plant, name, m, t) for name, m in self._orders(plant).items()]
        state, response = arranged(plant, chains)
        results = [ca.densify(state), ca.densify(response)]
        return ca.Function("fpirhc_reference", [t], results, ["t"], ["state", "response"])

    def given(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        """Return the signal of the set-points in force; announced ones of the next nodes follow node by node, 'q1@1'."""
        bank = self._bank(plant, stages)
        first = tuple(pairs(name, self.values[name])[0][1] for name in plant.chains)
        return (replace(bank.given, start=first * bank.nodes),)

    def own(self, plant: Plant, stages: int) -> tuple[Signal, ...]:
        """Return one signal with the filter's state, what is given, and the rate where it is live."""
        return (self._bank(plant, stages).own,)

    def block(self, plant: Plant, stages: int, period: float) -> Block:
        """Return the block of the filter, which also logs the set-points in force and the response of the reference."""
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

    def chain(self, plant: Plant, stages: int, coordinate: str, order: int) -> ca.Function:
        """Function (t, own signal) -> the coordinate's value and its derivatives up to `order`, shape (order + 1,).

        Raises:
            InvalidProblem: the order is above that of the filter.
        """
        own_order = self._orders(plant)[coordinate]
        if order > own_order:
            raise InvalidProblem(
                f"reference: derivatives of '{coordinate}' are needed up to order {order}, and the filter of its set-point has "
                f"order {own_order}; give Setpoint(order={order})"
            )
        return self._bank(plant, stages).chain(coordinate, order)

    def preview(self, plant: Plant, stages: int, step: float) -> ca.Function:
        """Function (own signal) -> (states (nx, N + 1), responses (n, N + 1)) at the nodes of a horizon."""
        return self._bank(plant, stages).preview(stages, step)

    def rests(self, until: float) -> bool:
        """Return whether no set-point changes up to some time, and the filter begins at the first ones."""
        steps = {name: pairs(name, values) for name, values in self.values.items()}
        still = all(time == 0 or time > until for one in steps.values() for time, _ in one)
        return still and all(value == steps[name][0][1] for name, value in self.start.items())

    def largest_jump(self, plant: Plant) -> float:
        """Largest jump of the controlled responses at a change of `values`; zero where the filter's order is above the plant's."""
        jumps: dict[float, list[float]] = {}
        for name in plant.controlled_names:
            order = plant.chains[name]
            if self._orders(plant)[name] == order:
                for time, change in self._changes(name):
                    jumps.setdefault(time, []).append(self._jump(plant, order) * change)
        return max((float(np.linalg.norm(together)) for together in jumps.values()), default=0.0)

    def _jump(self, plant: Plant, order: int) -> float:
        """Jump of the response at a set-point that changes by one."""
        rate = nominal(self.rate)
        return float(ca.evalf(chain_of(plant, rate, ca.SX.zeros(order), ca.SX(1.0), order))[-1])

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
        rate, rest = nominal(self.rate), self._rest(name)
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
