"""The plant: coordinates, inputs, relative order, response, and two sets of parameters.

A plant is given by its response: the highest derivative q^(r) of every coordinate as a CasADi expression of the lower
derivatives, the inputs u and the parameters p,

    q_i^(r_i) = f_i(q, q', ..., u, p).

The controller computes with the approximate parameters, and the simulated plant moves with the exact ones. The state vector is
derivative-major: all q, then the q' of the coordinates with order >= 2, and so on; its entries are named q1, q1', q1''.

The plant names the unit of time. Every time and rate of a problem (its period, a tracking law's rate) is in this unit; the numbers
themselves are not converted anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.errors import Mistakes, NotInvertible, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Few
from fpirhc.fields.user_code import called
from fpirhc.plant.algebraic import Algebraic
from fpirhc.plant.inverse import inverse_by_newton, inverse_by_user, inverse_of_affine
from fpirhc.plant.maps import Differences, check_map, next_function, over
from fpirhc.plant.outputs import Output, check_outputs, face_of, lie_derivatives, output_expression
from fpirhc.plant.parameter import Parameter, check_parameters
from fpirhc.plant.plant_check import check_names, check_ranges, check_response
from fpirhc.plant.plant_view import plant_facts, plant_table
from fpirhc.plant.structural_order import structural_order
from fpirhc.summary import line
from fpirhc.symbolic.layout import Expression, Named, Signal, scalar, vector

__all__ = ["Output", "Parameter", "Plant", "derivative_unit", "structural_order"]


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
        algebraic: quantities that equations tie to the state at every instant; the response has them as its last argument.
        outputs: name -> Output(unit, function of (q, q', ..., p)): the quantities that follow a reference, where these are not the
            coordinates themselves. Their relative orders are found from the symbols.
        time_unit: unit of time of the equations ('s', 'ms', 'day'), and so of every time and rate of the problem.
        step: of a map, the time from one state to the next; None: differential equations. See `Plant.of_map`.
        next: of a map, the function of (x, u, p) that returns {state: its value one step later}.
        steps: of a map, how many a control cycle has, with the command held; `Problem` counts them.

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
    ranges: Mapping[str, tuple[float, float]] = field(
        default_factory=dict, kw_only=True, metadata={"setting": "where given"}
    )
    algebraic: Algebraic | None = field(default=None, kw_only=True, metadata={"setting": "where given"})
    outputs: Mapping[str, Output] = field(default_factory=dict, kw_only=True, metadata={"setting": "where given"})
    time_unit: str = field(default="s", kw_only=True, metadata={"setting": False})
    step: float | None = field(default=None, kw_only=True, metadata={"setting": "where given"})
    next: Callable[..., Mapping[str, Expression]] | None = field(
        default=None, kw_only=True, metadata={"setting": "where given"}
    )
    steps: Few = field(default=1, kw_only=True, metadata={"setting": "where given"})

    def __post_init__(self) -> None:
        mistakes = Mistakes("plant")
        check_names(self, mistakes)
        check_map(self, mistakes)
        check_parameters(self.parameters, mistakes)
        mistakes.raise_if_any()
        check_ranges(self, mistakes)
        check_response(self, mistakes)
        mistakes.raise_if_any()
        check_outputs(self, mistakes)
        mistakes.raise_if_any()

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
        algebraic: Algebraic | None = None,
        time_unit: str = "s",
    ) -> Plant:
        """Return the plant x' = f(x, u, p), y = h(x, p): every state is a coordinate of order one, and the outputs have references.

        Args:
            states: name -> unit of every state.
            inputs: name -> unit of every input.
            parameters: name -> Parameter(approximate, exact, unit).
            rates: function of (x, u, p) that returns {state: its derivative with respect to time}.
            outputs: name -> Output(unit, function of (x, p)).
            controlled: outputs on which a tracking law and a deformation act, as many as there are inputs; None: all.
            inverse: optional function of (x, r, p) that returns {input: command} for wanted highest derivatives r of the controlled
                outputs; see `Plant`.
            ranges: physical range (lowest, highest) of states by name.
            algebraic: quantities that equations tie to the state at every instant; see `Plant`.
            time_unit: unit of time of the equations.

        Raises:
            InvalidProblem: all mistakes together.
        """
        return cls(
            coordinates=states,
            inputs=inputs,
            parameters=parameters,
            response=rates,
            order=1,
            controlled=controlled,
            inverse=inverse,
            ranges=ranges or {},
            outputs=outputs,
            algebraic=algebraic,
            time_unit=time_unit,
        )

    @classmethod
    def of_map(
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
        algebraic: Algebraic | None = None,
        time_unit: str = "s",
    ) -> Plant:
        """Return the map x+ = f(x, u, p), y = h(x, p), which steps and has no differential equation.

            plant = Plant.of_map(states={"stock": "t"}, inputs={"catch": "t/year"}, parameters={...}, next=grown, step=1.0, ...)

        A response is a divided difference, (y_{k+1} - y_k) / T for an output that an input reaches in one control cycle of T; see
        `fpirhc.plant.maps`. `Problem` takes no integrator for a map, and its period is a whole number of steps.

        Args:
            states: name -> unit of every state.
            inputs: name -> unit of every input.
            parameters: name -> Parameter(approximate, exact, unit), or outside(nominal, unit).
            next: function of (x, u, p) that returns {state: its value one step later}.
            step: time from one state to the next.
            outputs: name -> Output(unit, function of (x, p)); None: the states follow a reference.
            controlled: outputs, or states, on which a tracking law and a deformation act, as many as there are inputs; None: all.
            ranges: physical range (lowest, highest) of states by name.
            algebraic: quantities that equations tie to the state in every step; see `Plant`.
            time_unit: unit of time of the step.

        Raises:
            InvalidProblem: all mistakes together.
        """
        return cls(
            coordinates=states,
            inputs=inputs,
            parameters=parameters,
            response=Differences(next, tuple(states), step),  # type: ignore[arg-type]  # what is no mapping is refused by name
            order=1,
            controlled=controlled,
            ranges=ranges or {},
            outputs=outputs or {},
            algebraic=algebraic,
            time_unit=time_unit,
            step=step,
            next=next,
        )

    def __repr__(self) -> str:
        return line(self, *plant_facts(self))

    def _repr_html_(self) -> str:
        """Coordinates, inputs and parameters as a table, for notebooks."""
        return plant_table(self)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return tuple(self.coordinates)

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """Relative order of every coordinate."""
        order = self.order
        return tuple(order if isinstance(order, int) else order[c] for c in self.coordinates)

    @property
    def words(self) -> tuple[str, str]:
        """What a coordinate and the response are called: "state" and "rates", or "next", where the plant is given by its states."""
        if self.next is not None:
            return "state", "next"
        by_states = bool(self.outputs) and set(self.orders) == {1}
        return ("state", "rates") if by_states else ("coordinate", "response")

    @cached_property
    def state(self) -> Signal:
        """The state vector's signal: q, q', ... below the highest derivative."""
        names, units = [], []
        for k in range(max(self.orders)):
            for c, r in zip(self.names, self.orders, strict=True):
                if r > k:
                    names.append(c + "'" * k)
                    units.append(self.derivative_unit(self.coordinates[c], k))
        return vector("state", names, units)

    @cached_property
    def input(self) -> Signal:
        """The command's signal."""
        return vector("command", tuple(self.inputs), tuple(self.inputs.values()))

    @cached_property
    def parameter(self) -> Signal:
        """The parameters' signal."""
        return vector("parameters", tuple(self.parameters), tuple(p.unit for p in self.parameters.values()))

    @cached_property
    def signal_names(self) -> tuple[str, ...]:
        """Names of the parameters that are signals from outside."""
        return tuple(name for name, one in self.parameters.items() if one.outside)

    @cached_property
    def controlled_names(self) -> tuple[str, ...]:
        """The outputs, or without any the coordinates, on which tracking and deformation act.

        Raises:
            NotInvertible: another number of inputs, and `controlled` is None.
        """
        if self.controlled is not None:
            return tuple(self.controlled)
        names, what = (tuple(self.outputs), "outputs") if self.outputs else (self.names, "coordinates")
        if len(self.inputs) != len(names):
            raise NotInvertible(
                f"{len(self.inputs)} input(s) cannot prescribe {len(names)} {what}: name the "
                f"controlled ones, as many as there are inputs: Plant(..., controlled=({names[0]!r},))"
            )
        return names

    @cached_property
    def controlled_indices(self) -> tuple[int, ...]:
        """Places of the controlled coordinates among all coordinates.

        Raises:
            NotSupported: the controlled quantities are outputs; those of a face are coordinates.
        """
        if self.outputs:
            raise NotSupported(
                f"{', '.join(self.controlled_names)} are outputs of the plant and no coordinates, which this part does not cover"
            )
        return tuple(self.names.index(c) for c in self.controlled_names)

    @cached_property
    def face(self) -> Plant:
        """The plant as reference, tracking law, judging and sensors take it: its coordinates are the outputs; else itself."""
        return face_of(self) if self.outputs else self

    @cached_property
    def output(self) -> Signal:
        """The signal of what is measured of the face: the state without outputs, else y, y', ... below each relative order."""
        return replace(self.face.state, name="output") if self.outputs else self.state

    @cached_property
    def output_function(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> y, y', ... of the face; without outputs the state."""
        x, u, p = self.symbols()
        w = ca.SX.sym("w", len(self.names))
        chains = {
            name: lie_derivatives(self, output_expression(self, name, x, p), order, (x, u, p, w))
            for name, order in zip(self.face.names, self.face.orders, strict=True)
            if self.outputs
        }
        entries = [chains[e.rstrip("'")][e.count("'")] for e in self.output.elements] if self.outputs else [x]
        return ca.Function(
            "fpirhc_outputs", [x, u, p, w], [ca.densify(ca.vertcat(*entries))], ["x", "u", "p", "w"], ["y"]
        )

    @cached_property
    def known_by_outputs(self) -> tuple[int, ...]:
        """For every entry of the state its place among y, y', ...; -1 where it is none of these, and so has no reference."""
        x, u, p = self.symbols()
        if not self.outputs:
            return tuple(range(self.state.size))
        entries = ca.vertsplit(self.output_function(x, u, p, ca.SX.zeros(len(self.names))))
        equal = [[k for k, e in enumerate(entries) if ca.is_equal(e, x[i], 1)] for i in range(x.numel())]
        return tuple(places[0] if places else -1 for places in equal)

    @cached_property
    def time(self) -> Signal:
        """The time's signal."""
        return scalar("time", self.time_unit)

    def derivative_unit(self, unit: str, derivative: int) -> str:
        """Return the unit of a time derivative of a quantity in `unit`."""
        return derivative_unit(unit, derivative, self.time_unit)

    @cached_property
    def response_units(self) -> tuple[str, ...]:
        """Units of the highest derivative of every coordinate."""
        return tuple(self.derivative_unit(u, r) for u, r in zip(self.coordinates.values(), self.orders, strict=True))

    def response_signal(self, name: str) -> Signal:
        """Return a signal that holds a highest derivative of every controlled quantity."""
        units = [self.face.response_units[k] for k in self.face.controlled_indices]
        return vector(name, self.controlled_names, units)

    @cached_property
    def approximate(self) -> np.ndarray:
        """Parameters of the model, shape (np,)."""
        return np.array([p.approximate for p in self.parameters.values()], dtype=float)

    @cached_property
    def exact(self) -> np.ndarray:
        """Parameters of the plant, shape (np,)."""
        return np.array([p.exact for p in self.parameters.values()], dtype=float)

    def with_exact(self, exact: np.ndarray) -> Plant:
        """Return the plant with other exact parameters, shape (np,); both plants share the Functions derived from the symbols.

        Raises:
            InvalidProblem: a parameter that is not finite or outside its bounds.
        """
        named = zip(self.parameters.items(), exact, strict=True)
        # A spread is around the value of the problem file, and not around another plant's.
        parameters = {name: replace(one, exact=float(value), spread=None) for (name, one), value in named}
        mistakes = Mistakes("plant")
        check_parameters(parameters, mistakes)
        mistakes.raise_if_any()
        other = copy(self)
        # No other cached property depends on the exact values.
        other.__dict__.pop("exact", None)
        object.__setattr__(other, "parameters", parameters)
        return other

    @property
    def sampling(self) -> float:
        """Time from one state of a map to the next that a controller sees: the control cycle; NaN for differential equations."""
        return math.nan if self.step is None else self.step * self.steps

    def over(self, cycle: float) -> Plant:
        """Return the plant as a controller with this cycle sees it: a map's steps with the command held, or the plant itself.

        Raises:
            InvalidValue: the cycle is no whole number of the map's steps; the next ones are named.
        """
        return self if self.step is None else over(self, cycle)

    @cached_property
    def next_function(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state of a map one control cycle later."""
        return next_function(self)

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return new symbols of the state, the input and the parameters, with the sizes of this plant."""
        return (ca.SX.sym("x", self.state.size), ca.SX.sym("u", len(self.inputs)), ca.SX.sym("p", len(self.parameters)))

    def indices(self, derivative: int) -> tuple[int, ...]:
        """Places in the state vector of one derivative, for every coordinate whose order is higher."""
        elements = [c + "'" * derivative for c, r in zip(self.names, self.orders, strict=True) if r > derivative]
        return tuple(self.state.elements.index(e) for e in elements)

    @cached_property
    def response_function(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of every coordinate (n)."""
        x, u, p = self.symbols()
        if self.next is not None:
            differences = (self.next_function(x, u, p, ca.SX.zeros(len(self.names))) - x) / self.sampling
            return ca.Function("fpirhc_response", [x, u, p], [differences], ["x", "u", "p"], ["r"])
        views = self.views(x, u, p)
        if self.algebraic is not None:
            views = (*views, self.algebraic.view(self.algebraic_function(x, u, p)))
        responses = called(self.words[1], self.response, *views)
        column = ca.vertcat(*(ca.SX(responses[c]) for c in self.names))
        return ca.Function("fpirhc_response", [x, u, p], [ca.densify(column)], ["x", "u", "p"], ["r"])

    def views(self, x: Expression, u: Expression, p: Expression) -> tuple[Named, ...]:
        """Return the arguments of the response by name, without algebraic states: q, q', ..., u, p."""
        return (*self._derivatives(x), Named(self.input.elements, u, "input"), self._parameters(p))

    @cached_property
    def algebraic_function(self) -> ca.Function:
        """Function (state, input, parameters) -> algebraic states (nz); empty without any."""
        x, u, p = self.symbols()
        solution = ca.SX(0, 1)
        if self.algebraic is not None:
            solution = self.algebraic.solved(self.views(x, u, p), ca.vertcat(x, u, p))
        return ca.Function("fpirhc_algebraic", [x, u, p], [ca.densify(solution)], ["x", "u", "p"], ["z"])

    @cached_property
    def controlled_response_function(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of the controlled coordinates or outputs."""
        x, u, p = self.symbols()
        if self.outputs:
            calm, face = ca.SX.zeros(len(self.names)), self.face
            orders = {name: face.orders[face.names.index(name)] for name in self.controlled_names}
            chains = (
                lie_derivatives(self, output_expression(self, name, x, p), order, (x, u, p, calm))
                for name, order in orders.items()
            )
            responses = ca.densify(ca.vertcat(*(chain[-1] for chain in chains)))
        else:
            responses = self.response_function(x, u, p)[list(self.controlled_indices)]
        return ca.Function("fpirhc_controlled_response", [x, u, p], [responses], ["x", "u", "p"], ["r"])

    @cached_property
    def forced_derivative_function(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> dx/dt; `forcing` (n) adds to the responses."""
        x, u, p = self.symbols()
        w = ca.SX.sym("w", len(self.names))
        if self.next is not None:
            differences = (self.next_function(x, u, p, w) - x) / self.sampling
            return ca.Function("fpirhc_derivative", [x, u, p, w], [differences], ["x", "u", "p", "w"], ["xdot"])
        responses = self.response_function(x, u, p) + w
        rates = []
        for element in self.state.elements:
            higher = element + "'"
            if higher in self.state.elements:
                rates.append(x[self.state.elements.index(higher)])
            else:
                rates.append(responses[self.names.index(element.rstrip("'"))])
        return ca.Function("fpirhc_derivative", [x, u, p, w], [ca.vertcat(*rates)], ["x", "u", "p", "w"], ["xdot"])

    @cached_property
    def derivative_function(self) -> ca.Function:
        """Function (state, input, parameters) -> dx/dt, undisturbed."""
        x, u, p = self.symbols()
        rate = self.forced_derivative_function(x, u, p, ca.SX.zeros(len(self.names)))
        return ca.Function("fpirhc_free_derivative", [x, u, p], [rate], ["x", "u", "p"], ["xdot"])

    @cached_property
    def affine(self) -> bool:
        """Whether the controlled response is affine in the inputs, decided from the symbols."""
        x, u, p = self.symbols()
        return bool(ca.is_linear(self.controlled_response_function(x, u, p), u))

    @property
    def inverse_opaque(self) -> bool:
        """Whether the inverse response needs a root finder, for which scalar expressions do not suffice."""
        return self.inverse is None and not self.affine

    @cached_property
    def inverse_function(self) -> ca.Function:
        """Function (state, response of the controlled coordinates, parameters) -> input.

        An input that Newton's method does not find is NaN.

        Raises:
            NotInvertible: the inputs and the controlled coordinates differ in number.
        """
        if len(self.controlled_names) != len(self.inputs):
            raise NotInvertible(f"{len(self.controlled_names)} controlled coordinates need as many inputs")
        if self.inverse is not None:
            return inverse_by_user(self, self.inverse)
        return inverse_of_affine(self) if self.affine else inverse_by_newton(self)

    def _derivatives(self, x: Expression) -> list[Named]:
        views = []
        for k in range(max(self.orders)):
            holders = [c for c, r in zip(self.names, self.orders, strict=True) if r > k]
            views.append(Named(holders, x[list(self.indices(k))], self.words[0]))
        return views

    def _parameters(self, p: Expression) -> Named:
        return Named(tuple(self.parameters), p, "parameter")


def derivative_unit(unit: str, derivative: int, time: str = "s") -> str:
    """Return the unit of a time derivative, with the unit of time: 'm' -> 'm/s' -> 'm/s^2'."""
    if derivative == 0:
        return unit
    return f"{unit}/{time}" if derivative == 1 else f"{unit}/{time}^{derivative}"
