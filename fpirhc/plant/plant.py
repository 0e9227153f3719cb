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
from fpirhc.plant import by_states, by_steps, output_functions, plant_functions
from fpirhc.plant.algebraic import Algebraic
from fpirhc.plant.instant import instant_outputs, response_orders
from fpirhc.plant.inverse import inverse_function
from fpirhc.plant.maps import check_map, next_function, over
from fpirhc.plant.outputs import Output, check_outputs, face_of
from fpirhc.plant.parameter import Parameter, check_parameters, with_exact_values
from fpirhc.plant.plant_check import check_names, check_ranges, check_response
from fpirhc.plant.plant_view import plant_facts, plant_table
from fpirhc.plant.structural_order import structural_order
from fpirhc.plant.units import derivative_unit
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
    steps: Few = field(default=1, kw_only=True, metadata={"setting": False})

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

    of_states = classmethod(by_states.of_states)
    of_map = classmethod(by_steps.of_map)

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
        return ("state", "rates") if self.outputs and set(self.orders) == {1} else ("coordinate", "response")

    @cached_property
    def state(self) -> Signal:
        """The state vector's signal: q, q', ... below the highest derivative."""
        names, units = [], []
        for k in range(max(self.orders, default=0)):
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
    def instant_names(self) -> tuple[str, ...]:
        """Outputs of order 0, which the command moves at once."""
        return instant_outputs(self)

    @cached_property
    def output(self) -> Signal:
        """The signal of what is measured of the face: the state without outputs, else y, y', ... below each relative order."""
        return replace(self.face.state, name="output") if self.outputs else self.state

    @cached_property
    def output_function(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> y, y', ... of the face; without outputs the state."""
        return output_functions.output_function(self)

    @cached_property
    def known_by_outputs(self) -> tuple[int, ...]:
        """For every entry of the state its place among y, y', ...; -1 where it is none of these, and so has no reference."""
        return output_functions.known_by_outputs(self)

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
        """Return a signal that holds a highest derivative of every controlled quantity; of order 0 it is the quantity."""
        face = self.face.coordinates
        units = [self.derivative_unit(face[n], order) for n, order in response_orders(self).items()]
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
        parameters = with_exact_values(self.parameters, exact)
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
        return plant_functions.response_function(self)

    def views(self, x: Expression, u: Expression, p: Expression) -> tuple[Named, ...]:
        """Return the arguments of the response by name, without algebraic states: q, q', ..., u, p."""
        *derivatives, parameters = plant_functions.by_name(self, x, p)
        return (*derivatives, Named(self.input.elements, u, "input"), parameters)

    @cached_property
    def algebraic_function(self) -> ca.Function:
        """Function (state, input, parameters) -> algebraic states (nz); empty without any."""
        return plant_functions.algebraic_function(self)

    @cached_property
    def controlled_response_function(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of the controlled coordinates or outputs."""
        return output_functions.controlled_response_function(self)

    @cached_property
    def forced_derivative_function(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> dx/dt; `forcing` (n) adds to the responses."""
        return plant_functions.forced_derivative_function(self)

    @cached_property
    def derivative_function(self) -> ca.Function:
        """Function (state, input, parameters) -> dx/dt, undisturbed."""
        return plant_functions.derivative_function(self)

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
        return inverse_function(self)
