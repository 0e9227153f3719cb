"""The plant: one system x' = f(x, u, p) or x+ = f(x, u, p), behind three factories. Theory: docs/theory.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Few
from fpirhc.plant.equations import Equations
from fpirhc.plant.motion import derivative_unit, derivatives_signal
from fpirhc.plant.parameter import Parameter
from fpirhc.plant.plant_check import check_plant
from fpirhc.summary import line
from fpirhc.symbolic.expression import Expression
from fpirhc.symbolic.layout import Signal, scalar, vector

__all__ = ["Output", "Parameter", "Plant"]


@dataclass(frozen=True, eq=False)
class Output(Checked):
    """One output of a plant: y = h(q, q', ..., p), or h(x, p) of a plant that is given by its states.

    Args:
        unit: of the output.
        expression: function of the arguments of the response, with or without the inputs; it returns one scalar.
    """

    unit: str
    expression: Callable[..., Expression]


@dataclass(frozen=True, eq=False)
class Plant(Checked):
    """A system q^(r) = f(q, q', ..., u, p); a controller has its approximate parameters only.

    Args:
        coordinates: name -> unit of every coordinate.
        inputs: name -> unit of every input.
        parameters: name -> Parameter(approximate, exact, unit), or outside(nominal, unit) for a signal from outside.
        response: function of (q, q', ..., u, p) that returns {coordinate: its highest derivative}. It has one argument per
            derivative below the highest order, each with its entries by name (`q.q1`).
        order: relative order r, one number or {coordinate: number}.
        controlled: coordinates on which a tracking law and a deformation act, as many as there are inputs; None: all. They must
            be named where there are fewer inputs than coordinates. Where the plant has outputs they are outputs.
        inverse: optional function of (q, q', ..., r, p) that returns {input: command} for wanted responses r of the
            controlled coordinates. None: the inverse is derived where the response is affine in the inputs, and computed by
            Newton's method otherwise.
        ranges: physical range (lowest, highest) of states by name, such as {"level": (0.0, 2.0)}. A run whose plant leaves one ends
            there, by name; it limits nothing (see `Limits`).
        outputs: name -> Output(unit, function of (q, q', ..., p)): the quantities that follow a reference, where these are not the
            coordinates themselves. Their relative orders are found from the symbols.
        time_unit: unit of time of the equations ('s', 'ms', 'day'), and so of every time and rate of the problem.
        step: of a map, whose `response` gives the next state, the time until then; None: differential equations. See
            `Plant.discrete`.
        steps: of a map, how many a control cycle has, with the command held; `Problem` counts them.
        believed: coordinate, output, or response of an output (y'') -> the parameter that a model believes to add to it, as
            estimators of disturbances do; the user's functions do not have it. That of an output's response is in the inverse,
            and no state sees it: a plan is made without it, as one is made behind a deformation.

    Raises:
        InvalidProblem: all mistakes together.
    """

    coordinates: Mapping[str, str]
    inputs: Mapping[str, str]
    parameters: Mapping[str, Parameter]
    response: Callable[..., Mapping[str, Expression]]
    order: int | Mapping[str, int] = 2
    controlled: Sequence[str] | None = None
    inverse: Callable[..., Mapping[str, Expression]] | None = None
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict, kw_only=True)
    outputs: Mapping[str, Output] = field(default_factory=dict, kw_only=True)
    time_unit: str = field(default="s", kw_only=True)
    step: float | None = field(default=None, kw_only=True)
    steps: Few = field(default=1, kw_only=True)
    believed: Mapping[str, str] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        check_plant(self)

    @classmethod
    def of_states(
        cls,
        *,
        states: Mapping[str, str],
        inputs: Mapping[str, str],
        parameters: Mapping[str, Parameter],
        rates: Callable[..., Mapping[str, Expression]],
        outputs: Mapping[str, Output],
        controlled: Sequence[str] | None = None,
        inverse: Callable[..., Mapping[str, Expression]] | None = None,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        time_unit: str = "s",
    ) -> Self:
        """Return the plant x' = f(x, u, p), y = h(x, p): every state is a coordinate of order one, and the outputs have references.

        Args:
            states: name -> unit of every state; what is not named here is as in `Plant`.
            rates: function of (x, u, p) that returns {state: its derivative with respect to time}.
            outputs: name -> Output(unit, function of (x, p)).
            inverse: optional function of (x, r, p) that returns {input: command} for wanted highest derivatives r of the controlled
                outputs.
        """
        given = (states, inputs, parameters, rates, 1, controlled, inverse)
        return cls(*given, ranges=ranges or {}, outputs=outputs, time_unit=time_unit)

    @classmethod
    def discrete(
        cls,
        *,
        states: Mapping[str, str],
        inputs: Mapping[str, str],
        parameters: Mapping[str, Parameter],
        next: Callable[..., Mapping[str, Expression]],
        step: float,
        outputs: Mapping[str, Output] | None = None,
        controlled: Sequence[str] | None = None,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        time_unit: str = "s",
    ) -> Self:
        """Return the map x+ = f(x, u, p), y = h(x, p), which steps and has no differential equation.

            plant = Plant.discrete(states={"stock": "t"}, inputs={"catch": "t/year"}, parameters={...}, next=grown, step=1.0, ...)

        A response is a divided difference, (y_{k+1} - y_k) / T for an output that an input reaches in one control cycle of T; see
        `fpirhc.plant.maps`. A map has no use for an integrator, and the period of its `Problem` is a whole number of steps.

        Args:
            states: name -> unit of every state; what is not named here is as in `Plant`.
            next: function of (x, u, p) that returns {state: its value one step later}.
            step: time from one state to the next.
            outputs: name -> Output(unit, function of (x, p)); None: the states follow a reference.
        """
        given, every = (states, inputs, parameters, next, 1, controlled), math.nan if step is None else step
        return cls(*given, ranges=ranges or {}, outputs=outputs or {}, time_unit=time_unit, step=every)

    def __repr__(self) -> str:
        return line(self, *plant_facts(self))

    @cached_property
    def equations(self) -> Equations:
        """The CasADi Functions of the plant."""
        return Equations(self)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return tuple(self.coordinates)

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """Relative order of every coordinate."""
        order = self.order
        return tuple(order if isinstance(order, int) else order[c] for c in self.coordinates)

    @cached_property
    def state(self) -> Signal:
        """The state vector's signal: q, q', ... below the highest derivative."""
        orders = dict(zip(self.names, self.orders, strict=True))
        return derivatives_signal("state", self.coordinates, orders, self.time_unit)

    @cached_property
    def followed(self) -> dict[str, str]:
        """Name -> unit of what may follow a reference: the outputs, or without any the coordinates."""
        return {name: one.unit for name, one in self.outputs.items()} if self.outputs else dict(self.coordinates)

    @cached_property
    def output(self) -> Signal:
        """The signal of what follows a reference: the state without outputs, else y, y', ... below each relative order."""
        if not self.outputs:
            return self.state
        return derivatives_signal("output", self.followed, self.chains, self.time_unit)

    @cached_property
    def beside(self) -> tuple[Signal, ...]:
        """The signal of the outputs, where they are given beside the state."""
        return (self.output,) if self.outputs else ()

    @property
    def motion(self) -> tuple[Signal, ...]:
        """The signals of what a controller is given of the motion: the state, and the outputs where there are any."""
        return (self.state, *self.beside)

    @property
    def time(self) -> Signal:
        """The time's signal."""
        return scalar("time", self.time_unit)

    @cached_property
    def input(self) -> Signal:
        """The command's signal."""
        return vector("command", tuple(self.inputs), tuple(self.inputs.values()))

    @cached_property
    def parameter(self) -> Signal:
        """The parameters' signal."""
        return vector("parameters", tuple(self.parameters), tuple(p.unit for p in self.parameters.values()))

    @cached_property
    def outside(self) -> tuple[str, ...]:
        """Names of the parameters that are signals from outside."""
        return tuple(name for name, one in self.parameters.items() if one.outside)

    @cached_property
    def forcing(self) -> Signal:
        """The signal of what adds to the highest derivative of every coordinate."""
        units = zip(self.coordinates.values(), self.orders, strict=True)
        return Signal("forcing", self.names, tuple(derivative_unit(u, order, self.time_unit) for u, order in units))

    @cached_property
    def chains(self) -> dict[str, int]:
        """Length of the chain y, y', ... of every output, or coordinate, in `output`: its relative order, at least one."""
        return {name: max(order, 1) for name, order in self.equations.output_orders.items()}

    @cached_property
    def response_orders(self) -> dict[str, int]:
        """Relative orders of the controlled quantities."""
        return {name: self.equations.output_orders[name] for name in self.controlled_names}

    @cached_property
    def at_once(self) -> tuple[str, ...]:
        """Names of the controlled quantities of order 0, which the command moves at once: each is its own response."""
        return tuple(n for n in self.controlled or self.chains if not self.equations.output_orders[n])

    @property
    def response_age(self) -> int:
        """How many cycles before a measured response its state was: one where it is a difference of a map, else none."""
        return 0 if self.step is None or self.at_once else 1

    @cached_property
    def differences(self) -> dict[str, int]:
        """Of every controlled quantity over how many cycles its response is a difference: its order on a map, else none."""
        return {name: self.response_age * order for name, order in self.response_orders.items()}

    def response_signal(self, name: str) -> Signal:
        """Return a signal that holds a highest derivative of every controlled quantity; of order 0 it is the quantity."""
        return Signal(name, self.controlled_names, self._response_units)

    @cached_property
    def _response_units(self) -> tuple[str, ...]:
        units, time = self.followed, self.time_unit
        return tuple(derivative_unit(units[n], order, time) for n, order in self.response_orders.items())

    @cached_property
    def controlled_names(self) -> tuple[str, ...]:
        """The outputs, or without any the coordinates, on which tracking and deformation act."""
        if self.controlled is not None:
            return tuple(self.controlled)
        names, what = (tuple(self.outputs), "outputs") if self.outputs else (self.names, "coordinates")
        if len(self.inputs) > len(names):
            raise InvalidProblem(
                f"{len(self.inputs)} inputs ({', '.join(self.inputs)}) for {len(names)} of the {what} ({', '.join(names)}): each "
                "input holds one. Add an output that the other input moves, leave an input out, or make one input of several: an "
                "effort that the equations share out among them, by weights ('More inputs than outputs' in docs/plants.md)"
            )
        if len(self.inputs) != len(names):
            raise InvalidProblem(
                f"{len(self.inputs)} input{'s' * (len(self.inputs) > 1)} cannot hold {len(names)} {what}: name the "
                f"controlled ones, as many as there are inputs: Plant(..., controlled=({names[0]!r},))"
            )
        return names

    def controlling(self, name: str) -> Self:
        """Return the plant that controls one quantity; its coordinates are outputs, whose orders are found from the symbols."""
        shown = self.outputs or {n: Output(unit, lambda *q, n=n: q[0][n]) for n, unit in self.coordinates.items()}
        inverse = self.inverse if self.controlled_names == (name,) else None
        return replace(self, outputs=shown, controlled=(name,), inverse=inverse)

    @cached_property
    def approximate(self) -> np.ndarray:
        """Parameters of the model, shape (np,)."""
        return np.array([p.approximate for p in self.parameters.values()], dtype=float)

    @cached_property
    def exact(self) -> np.ndarray:
        """Parameters of the plant, shape (np,)."""
        return np.array([p.exact for p in self.parameters.values()], dtype=float)

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return new symbols of the state, the input and the parameters, with the sizes of this plant."""
        inputs, parameters = len(self.inputs), len(self.parameters)
        return ca.SX.sym("x", self.state.size), ca.SX.sym("u", inputs), ca.SX.sym("p", parameters)


def plant_facts(plant: Plant) -> tuple[str, ...]:
    """Return what sums up a plant: its coordinates or outputs with their orders, its inputs, the number of its parameters."""
    relative = "relative " * bool(plant.outputs)
    shown = ", ".join(f"{name} of {relative}order {order}" for name, order in plant.equations.output_orders.items())
    first = (f"outputs {shown}", f"{plant.state.size} states") if plant.outputs else (shown,)
    return *first, f"inputs {', '.join(plant.inputs)}", f"{len(plant.parameters)} parameters"
