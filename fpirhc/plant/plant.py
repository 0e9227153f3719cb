"""The plant: coordinates, inputs, relative order, response, and two sets of parameters.

Theory: docs/theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self

import casadi as ca

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.plant.lie_derivatives import (
    believed_disturbance,
    check_outputs,
    lie_derivatives,
    output_expression,
    output_order,
    structural_order,
)
from fpirhc.plant.maps import Differences, check_map
from fpirhc.plant.motion import (
    Motion,
    MotionEquations,
    Output,
    affine,
    controlled_places,
    derivative_unit,
    followed_units,
    inverse_function,
)
from fpirhc.plant.parameter import Parameter, check_parameters
from fpirhc.plant.plant_check import check_names, check_ranges, check_response
from fpirhc.summary import line, number, table
from fpirhc.symbolic.layout import Expression, Signal, vector

__all__ = ["Output", "Parameter", "Plant", "derivative_unit", "structural_order"]


@dataclass(frozen=True, eq=False)
class Plant(Motion):
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
        step: of a map, the time from one state to the next; None: differential equations. See `Plant.discrete`.
        next: of a map, the function of (x, u, p) that returns {state: its value one step later}.
        steps: of a map, how many a control cycle has, with the command held; `Problem` counts them.

    Raises:
        InvalidProblem: all mistakes together.
    """

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
        time_unit: str = "s",
    ) -> Self:
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
            time_unit=time_unit,
        )

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
            time_unit: unit of time of the step.

        Raises:
            InvalidProblem: all mistakes together.
        """
        return cls(
            coordinates=states,
            inputs=inputs,
            parameters=parameters,
            response=Differences(next, tuple(states), step),
            order=1,
            controlled=controlled,
            ranges=ranges or {},
            outputs=outputs or {},
            time_unit=time_unit,
            step=step,
            next=next,
        )

    def __repr__(self) -> str:
        return line(self, *plant_facts(self))

    def _repr_html_(self) -> str:
        """Coordinates, inputs and parameters as a table, for notebooks."""
        return _plant_table(self)

    @cached_property
    def equations(self) -> Equations:
        return Equations(self)

    @cached_property
    def chains(self) -> dict[str, int]:
        """Length of the chain y, y', ... of every output, or coordinate, in `output`: its relative order, at least one."""
        return {name: max(order, 1) for name, order in self.equations.output_orders.items()}

    @cached_property
    def response_orders(self) -> dict[str, int]:
        """Those of the controlled ones."""
        return {name: self.equations.output_orders[name] for name in self.controlled_names}

    @cached_property
    def output(self) -> Signal:
        """The signal of what follows a reference: the state without outputs, else y, y', ... below each relative order."""
        return self._derivatives("output", followed_units(self), self.chains) if self.outputs else self.state

    def response_signal(self, name: str) -> Signal:
        """Return a signal that holds a highest derivative of every controlled quantity; of order 0 it is the quantity."""
        return vector(name, self.controlled_names, self._controlled_units)

    @cached_property
    def _controlled_units(self) -> tuple[str, ...]:
        units, time = followed_units(self), self.time_unit
        return tuple([derivative_unit(units[n], order, time) for n, order in self.response_orders.items()])


def plant_facts(plant: Plant) -> tuple[str, ...]:
    """Return what sums up a plant: its coordinates or outputs with their orders, its inputs, the number of its parameters."""
    if plant.outputs:
        shown = ", ".join(f"{name} of relative order {order}" for name, order in plant.equations.output_orders.items())
        states = f"{plant.state.size} states"
        return f"outputs {shown}", states, f"inputs {', '.join(plant.inputs)}", f"{len(plant.parameters)} parameters"
    orders = ", ".join(f"{name} of order {order}" for name, order in zip(plant.names, plant.orders, strict=True))
    return orders, f"inputs {', '.join(plant.inputs)}", f"{len(plant.parameters)} parameters"


def _plant_table(plant: Plant) -> str:
    """Return HTML: coordinates, inputs and parameters, one per row."""
    rows = [
        (name, f"coordinate, order {order}", unit, "", "")
        for (name, unit), order in zip(plant.coordinates.items(), plant.orders, strict=True)
    ]
    for name, one in plant.outputs.items():
        rows.append((name, f"output, relative order {plant.equations.output_orders[name]}", one.unit, "", ""))
    rows += [(name, "input", unit, "", "") for name, unit in plant.inputs.items()]
    rows += [
        (
            name,
            "signal from outside" if one.outside else "parameter",
            one.unit,
            number(one.approximate),
            number(one.exact),
        )
        for name, one in plant.parameters.items()
    ]
    notes = [f"Unit of time: {plant.time_unit}."]
    if plant.controlled is not None:
        notes.append(f"Controlled: {', '.join(plant.controlled)}.")
    return table("Plant", ("name", "is", "unit", "model", "plant"), rows, notes)


class Equations(MotionEquations):
    """What a plant's equations say, each Function made when it is asked for."""

    motion: Plant

    @cached_property
    def output_orders(self) -> dict[str, int]:
        """Relative order of every output, or coordinate: the derivative that the command moves at once; 0 for the output itself.

        An output that no input reaches has the order one.
        """
        if not self.motion.outputs:
            return dict(zip(self.motion.names, self.motion.orders, strict=True))
        orders = {name: output_order(self.motion, name) for name in self.motion.outputs}
        return {name: 1 if order is None else order for name, order in orders.items()}

    @cached_property
    def output(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> y, y', ... of the outputs; without outputs the state."""
        x, u, p = self.motion.symbols()
        w = ca.SX.sym("w", len(self.motion.names))
        chains = {
            name: lie_derivatives(self.motion, output_expression(self.motion, name, x, u, p), order, (x, u, p, w))
            for name, order in self.motion.chains.items()
            if self.motion.outputs
        }
        entries = (
            [chains[e.rstrip("'")][e.count("'")] for e in self.motion.output.elements] if self.motion.outputs else [x]
        )
        return ca.Function(
            "fpirhc_outputs", [x, u, p, w], [ca.densify(ca.vertcat(*entries))], ["x", "u", "p", "w"], ["y"]
        )

    @cached_property
    def known_by_outputs(self) -> tuple[int, ...]:
        """For every entry of the state its place among y, y', ...; -1 where it is none of these, and so has no reference."""
        x, u, p = self.motion.symbols()
        if not self.motion.outputs:
            return tuple(range(self.motion.state.size))
        entries = ca.vertsplit(self.output(x, u, p, ca.SX.zeros(len(self.motion.names))))
        equal = [[k for k, e in enumerate(entries) if ca.is_equal(e, x[i], 1)] for i in range(x.numel())]
        return tuple(places[0] if places else -1 for places in equal)

    @property
    def known_on_reference(self) -> bool:
        """Whether the reference gives the whole state."""
        return min(self.known_by_outputs) >= 0

    @cached_property
    def controlled_response(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of the controlled coordinates or outputs.

        The response of an output of order 0 is the output.
        """
        x, u, p = self.motion.symbols()
        if self.motion.outputs:
            calm = ca.SX.zeros(len(self.motion.names))
            chains = {
                name: lie_derivatives(
                    self.motion, output_expression(self.motion, name, x, u, p), order, (x, u, p, calm)
                )
                for name, order in self.motion.response_orders.items()
            }
            entries = (chain[-1] + believed_disturbance(self.motion, name, p) for name, chain in chains.items())
            responses = ca.densify(ca.vertcat(*entries))
        else:
            responses = self.response(x, u, p)[controlled_places(self.motion)]
        return ca.Function("fpirhc_controlled_response", [x, u, p], [responses], ["x", "u", "p"], ["r"])

    @cached_property
    def input_gain(self) -> ca.Function:
        """Function (state, input, parameters) -> derivative of the controlled response with respect to the inputs."""
        x, u, p = self.motion.symbols()
        return ca.Function("fpirhc_input_gain", [x, u, p], [ca.jacobian(self.controlled_response(x, u, p), u)])

    @cached_property
    def affine(self) -> bool:
        """Whether the controlled response is affine in the inputs, decided from the symbols."""
        return affine(self.motion, self.controlled_response)

    @property
    def inverse_opaque(self) -> bool:
        """Whether the inverse response needs a root finder, for which scalar expressions do not suffice."""
        return self.motion.inverse is None and not self.affine

    @cached_property
    def inverse(self) -> ca.Function:
        """Function (state, response of the controlled coordinates, parameters) -> input.

        An input that Newton's method does not find is NaN.

        Raises:
            NotInvertible: the inputs and the controlled coordinates differ in number.
        """
        return inverse_function(self.motion, self.controlled_response)


class Parametric(Protocol):
    """What has exact parameters: a plant, or a body outside."""

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """By name."""


def exact_ranges(plant: Parametric, mismatch: float) -> dict[str, tuple[float, float]]:
    """Return the least and the largest value of every exact parameter, |p - p_exact| <= P/100 |p_exact| for P percent, P < 100.

    p_exact is the value in the problem file: a parameter keeps its sign, and zero stays zero. One with a `spread` lies in P/100 of
    that spread; where all parameters have one, P may be 100 and more.
    """
    check_mismatch(plant, mismatch)
    ranges = {name: _range(parameter, mismatch) for name, parameter in plant.parameters.items()}
    mistakes = Mistakes("mismatch")
    for name, parameter in plant.parameters.items():
        (low, high), (least, largest) = parameter.bounds, ranges[name]
        if least < low or largest > high:
            mistakes.add(
                f"parameter '{name}': {mismatch:g} % around {parameter.exact:g} reach from {least:g} to {largest:g} "
                f"{parameter.unit}, outside its bounds ({low:g}, {high:g}); at most {_most(parameter):.3g} % stay inside"
            )
    mistakes.raise_if_any()
    return ranges


def check_mismatch(plant: Parametric, mismatch: float) -> None:
    """Raise if no range belongs to this mismatch."""
    all_spread = bool(plant.parameters) and all(p.spread is not None or p.outside for p in plant.parameters.values())
    if not 0 <= mismatch < (math.inf if all_spread else 100):
        raise InvalidValue(
            f"mismatch {mismatch:g}: expected percent of at least 0 and below 100, where a parameter keeps its sign"
            + (
                " (100 is the whole spread, more is possible here)"
                if all_spread
                else "; where all have a spread, 100 is all of it"
            )
        )


def drawn(parameter: Parameter, mismatch: float, share: float) -> float:
    """Return the exact value at this share of the distribution, from 0 to 1.

    Without a spread the factor is log-uniform between 1 - P/100 and 1 + P/100.
    """
    if parameter.outside:
        return parameter.exact
    if parameter.spread is not None:
        return parameter.spread.quantile(parameter.exact, mismatch / 100, share)
    low, high = math.log1p(-mismatch / 100), math.log1p(mismatch / 100)
    return parameter.exact * (math.exp(low + (high - low) * share) if mismatch else 1.0)


def _range(parameter: Parameter, mismatch: float) -> tuple[float, float]:
    if parameter.outside:  # its values are those of the problem
        return parameter.exact, parameter.exact
    if parameter.spread is not None:
        return parameter.spread.interval(parameter.exact, mismatch / 100)
    width = mismatch / 100 * abs(parameter.exact)
    return parameter.exact - width, parameter.exact + width


def _most(parameter: Parameter) -> float:
    """The largest mismatch that stays inside the bounds, percent; ranges grow with it, so bisection finds it."""
    low, high = parameter.bounds
    inside, outside = 0.0, 100.0
    while low <= _range(parameter, outside)[0] and _range(parameter, outside)[1] <= high:
        inside, outside = outside, 2 * outside
    for _ in range(60):
        middle = (inside + outside) / 2
        least, largest = _range(parameter, middle)
        inside, outside = (middle, outside) if low <= least and largest <= high else (inside, middle)
    return inside
