"""The motion of a plant: named quantities with units, two sets of parameters, and their CasADi Functions.

    response    r = f(x, u, p),        x' = (q', q'', ..., f(x, u, p) + w)

with the state x = (q, q', ...), derivative-major, and a forcing w that adds to the highest derivatives.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import casadi as ca
import numpy as np

from fpirhc.errors import Mistakes, NotInvertible
from fpirhc.fields.checked import Checked, missing
from fpirhc.fields.kinds import Few
from fpirhc.fields.user_code import called, named_results, scalar_expression
from fpirhc.plant.parameter import Parameter, with_exact_values
from fpirhc.symbolic.expression import FINITE, expression, graph, nan_where
from fpirhc.symbolic.layout import Expression, Named, Signal, scalar, vector


@dataclass(frozen=True, eq=False)
class Output(Checked):
    """One output of a plant: y = h(q, q', ..., p), or h(x, p) of a plant that is given by its states.

    Args:
        unit: of the output.
        expression: function of the arguments of the response, with or without the inputs; it returns one scalar.
        response_disturbance: name of a parameter that a model believes to add to the response y^(r) and to nothing else, as
            estimators of disturbances do; empty: none. The inverse has it in every cycle. A plan is made without it, as if the
            response were the model's, which is how a plan is made behind a deformation.
    """

    unit: str
    expression: Callable[..., Expression]
    response_disturbance: str = field(default="", kw_only=True, metadata={"setting": False})


_Motion = TypeVar("_Motion", bound="Motion")


@dataclass(frozen=True, eq=False)
class Motion(Checked):
    """What moves: x' = f(x, u, p), or x+ = f(x, u, p); the fields are described at `Plant`."""

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
    outputs: Mapping[str, Output] = field(default_factory=dict, kw_only=True, metadata={"setting": "where given"})
    time_unit: str = field(default="s", kw_only=True, metadata={"setting": False})
    step: float | None = field(default=None, kw_only=True, metadata={"setting": "where given"})
    next: Callable[..., Mapping[str, Expression]] | None = field(
        default=None, kw_only=True, metadata={"setting": "where given"}
    )
    steps: Few = field(default=1, kw_only=True, metadata={"setting": False})

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
        return self._derivatives("state", self.coordinates, dict(zip(self.names, self.orders, strict=True)))

    def _derivatives(self, name: str, units: Mapping[str, str], orders: Mapping[str, int]) -> Signal:
        """Signal of some quantities and their derivatives below each order, derivative-major."""
        entries = [(n, k) for k in range(max(orders.values(), default=0)) for n, order in orders.items() if order > k]
        own = [derivative_unit(units[n], k, self.time_unit) for n, k in entries]
        return vector(name, [n + "'" * k for n, k in entries], own)

    @cached_property
    def input(self) -> Signal:
        """The command's signal."""
        return vector("command", tuple(self.inputs), tuple(self.inputs.values()))

    @cached_property
    def parameter(self) -> Signal:
        """The parameters' signal."""
        return vector("parameters", tuple(self.parameters), tuple(p.unit for p in self.parameters.values()))

    @cached_property
    def controlled_names(self) -> tuple[str, ...]:
        """The outputs, or without any the coordinates, on which tracking and deformation act.

        Raises:
            NotInvertible: another number of inputs, and `controlled` is None.
        """
        if self.controlled is not None:
            return tuple(self.controlled)
        names, what = (tuple(self.outputs), "outputs") if self.outputs else (self.names, "coordinates")
        if len(self.inputs) > len(names):
            raise NotInvertible(
                f"{len(self.inputs)} inputs ({', '.join(self.inputs)}) for {len(names)} of the {what} ({', '.join(names)}): each "
                "input holds one. Add an output that the other input moves, leave an input out, or make one input of several: an "
                "effort that the equations share out among them, by weights ('More inputs than outputs' in docs/plants.md)"
            )
        if len(self.inputs) != len(names):
            raise NotInvertible(
                f"{len(self.inputs)} input{'s' * (len(self.inputs) > 1)} cannot hold {len(names)} {what}: name the "
                f"controlled ones, as many as there are inputs: Plant(..., controlled=({names[0]!r},))"
            )
        return names

    @cached_property
    def approximate(self) -> np.ndarray:
        """Parameters of the model, shape (np,)."""
        return np.array([p.approximate for p in self.parameters.values()], dtype=float)

    @cached_property
    def exact(self) -> np.ndarray:
        """Parameters of the plant, shape (np,)."""
        return np.array([p.exact for p in self.parameters.values()], dtype=float)

    @cached_property
    def equations(self) -> MotionEquations:
        """The CasADi Functions of the motion."""
        return MotionEquations(self)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> object:
            raise missing(type(self), name)

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return new symbols of the state, the input and the parameters, with the sizes of this plant."""
        return (ca.SX.sym("x", self.state.size), ca.SX.sym("u", len(self.inputs)), ca.SX.sym("p", len(self.parameters)))


def words(motion: Motion) -> tuple[str, str]:
    """What a coordinate and the response are called: "state" and "rates", or "next", where the plant is given by its states."""
    if motion.next is not None:
        return "state", "next"
    return ("state", "rates") if motion.outputs and set(motion.orders) == {1} else ("coordinate", "response")


def followed(motion: Motion) -> str:
    """What a quantity is called that follows a reference: "output" or "coordinate"."""
    return "output" if motion.outputs else "coordinate"


def disturbed(motion: Motion) -> str:
    """What quantities are called that disturbances may add to."""
    return "input, coordinate or output" if motion.outputs else "input or coordinate"


def followed_units(motion: Motion) -> dict[str, str]:
    """Return name -> unit of what may follow a reference: the outputs, or without any the coordinates."""
    return {name: one.unit for name, one in motion.outputs.items()} if motion.outputs else dict(motion.coordinates)


def input_columns(motion: Motion) -> tuple[str, ...]:
    """Names of the inputs in tables that hold states too: "input NAME" where a coordinate has the name of an input."""
    return tuple(f"input {name}" if name in motion.coordinates else name for name in motion.inputs)


def time_signal(motion: Motion) -> Signal:
    """Return the time's signal."""
    return scalar("time", motion.time_unit)


def forcing_units(motion: Motion) -> tuple[str, ...]:
    """Return the units of the highest derivative of every coordinate, to which a forcing adds."""
    units = zip(motion.coordinates.values(), motion.orders, strict=True)
    return tuple(derivative_unit(unit, order, motion.time_unit) for unit, order in units)


def sampling(motion: Motion) -> float:
    """Return the time from one state of a map to the next that a controller sees, its cycle; NaN for differential equations."""
    return math.nan if motion.step is None else motion.step * motion.steps


def with_exact_parameters(motion: _Motion, exact: np.ndarray) -> _Motion:
    """Return the same with other exact parameters, shape (np,); both share the Functions derived from the symbols."""
    parameters = with_exact_values(motion.parameters, exact)
    other = copy(motion)
    # No other cached property depends on the exact values.
    other.__dict__.pop("exact", None)
    object.__setattr__(other, "parameters", parameters)
    return other


def known_exactly(motion: _Motion) -> _Motion:
    """Return the same with the exact parameters as approximate ones."""
    named = {name: replace(one, approximate=one.exact, spread=None) for name, one in motion.parameters.items()}
    return replace(motion, parameters=named)


def with_outputs_of(motion: _Motion, model: Motion) -> _Motion:
    """Return a motion with the outputs of a model; itself where it has the same."""
    return motion if tuple(motion.outputs) == tuple(model.outputs) else replace(motion, outputs=model.outputs)


def outside_names(motion: Motion) -> tuple[str, ...]:
    """Return the names of the parameters that are signals from outside."""
    return tuple(name for name, one in motion.parameters.items() if one.outside)


def outside_of(motion: Motion, parameters: Expression) -> Named:
    """Return the signals from outside among the symbols of all parameters, by name."""
    names, every = outside_names(motion), list(motion.parameters)
    return Named(names, ca.vertcat(*(parameters[every.index(name)] for name in names)), "signal from outside")


def controlled_places(motion: Motion) -> list[int]:
    """Return the places of the controlled quantities among all outputs, or without any among all coordinates."""
    names = list(followed_units(motion))
    return [names.index(c) for c in motion.controlled_names]


def places(motion: Motion, derivative: int) -> list[int]:
    """Return the places in the state vector of one derivative, for every coordinate whose order is higher."""
    elements = [c + "'" * derivative for c, r in zip(motion.names, motion.orders, strict=True) if r > derivative]
    return [motion.state.elements.index(e) for e in elements]


def arguments_of(motion: Motion, x: Expression, u: Expression, p: Expression) -> tuple[Named, ...]:
    """Return the arguments of the response by name: q, q', ..., u, p."""
    *derivatives, parameters = by_name(motion, x, p)
    return (*derivatives, Named(motion.input.elements, u, "input"), parameters)


def by_name(motion: Motion, x: Expression, p: Expression) -> tuple[Named, ...]:
    """Return the arguments of a user's function without the inputs, each with its entries by name: q, q', ..., p."""
    derivatives = [
        Named(
            [c for c, r in zip(motion.names, motion.orders, strict=True) if r > k],
            x[places(motion, k)],
            words(motion)[0],
        )
        for k in range(max(motion.orders, default=0))
    ]
    return (*derivatives, Named(tuple(motion.parameters), p, "parameter"))


class MotionEquations:
    """The CasADi Functions of a motion, each made when it is asked for; other exact parameters do not change them."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion

    @cached_property
    def response(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of every coordinate (n)."""
        x, u, p = self.motion.symbols()
        if self.motion.next is not None:
            differences = (self.next(x, u, p, ca.SX.zeros(len(self.motion.names))) - x) / sampling(self.motion)
            return ca.Function("fpirhc_response", [x, u, p], [differences], ["x", "u", "p"], ["r"])
        views = arguments_of(self.motion, x, u, p)
        responses = called(words(self.motion)[1], self.motion.response, *views)
        column = ca.vertcat(*(ca.SX(responses[c]) for c in self.motion.names))
        return ca.Function("fpirhc_response", [x, u, p], [ca.densify(column)], ["x", "u", "p"], ["r"])

    @cached_property
    def forced_rate(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> dx/dt; `forcing` (n) adds to the responses."""
        x, u, p = self.motion.symbols()
        w = ca.SX.sym("w", len(self.motion.names))
        if self.motion.next is not None:
            differences = (self.next(x, u, p, w) - x) / sampling(self.motion)
            return ca.Function("fpirhc_derivative", [x, u, p, w], [differences], ["x", "u", "p", "w"], ["xdot"])
        responses = self.response(x, u, p) + w
        rates = []
        for element in self.motion.state.elements:
            higher = element + "'"
            if higher in self.motion.state.elements:
                rates.append(x[self.motion.state.elements.index(higher)])
            else:
                rates.append(responses[self.motion.names.index(element.rstrip("'"))])
        return ca.Function("fpirhc_derivative", [x, u, p, w], [ca.vertcat(*rates)], ["x", "u", "p", "w"], ["xdot"])

    @cached_property
    def rate(self) -> ca.Function:
        """Function (state, input, parameters) -> dx/dt, undisturbed."""
        x, u, p = self.motion.symbols()
        rate = self.forced_rate(x, u, p, ca.SX.zeros(len(self.motion.names)))
        return ca.Function("fpirhc_free_derivative", [x, u, p], [rate], ["x", "u", "p"], ["xdot"])

    @cached_property
    def next(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state of a map one control cycle later.

        In each of the cycle's steps x+ = f(x, u, p) + step * forcing: a forcing adds to the divided differences.
        """
        assert self.motion.step is not None
        x, u, p = self.motion.symbols()
        w = ca.SX.sym("w", len(self.motion.names))
        if self.motion.next is None:
            after = x + sampling(self.motion) * self.forced_rate(x, u, p, w)
            return ca.Function("fpirhc_next", [x, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])
        one = ca.Function("fpirhc_step", [x, u, p], [_one_step(self.motion, self.motion.next, x, u, p)])
        after = x
        for _ in range(self.motion.steps):
            after = one(after, u, p) + self.motion.step * w
        return ca.Function("fpirhc_next", [x, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])


def _one_step(motion: Motion, step: Callable[..., Mapping[str, Expression]], x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    views = arguments_of(motion, x, u, p)
    values = called("next", step, *views)
    symbols = (x, u, p)
    entries = [scalar_expression(f"next of '{name}'", values[name], of=step, symbols=symbols) for name in motion.names]
    return ca.densify(ca.vertcat(*(ca.SX(entry) for entry in entries)))


SECONDS = {"s": 1.0, "us": 1e-6, "ms": 1e-3, "min": 60.0, "h": 3600.0, "day": 86400.0}
"""Seconds in a unit of time, for what is compared with a real clock."""


def derivative_unit(unit: str, derivative: int, time: str = "s") -> str:
    """Return the unit of a time derivative, with the unit of time: 'm' -> 'm/s' -> 'm/s^2'."""
    if derivative == 0:
        return unit
    if found := re.fullmatch(rf"(.+)/{re.escape(time)}(?:\^(\d+))?", unit):
        unit, derivative = found[1], derivative + int(found[2] or 1)
    return f"{unit}/{time}" if derivative == 1 else f"{unit}/{time}^{derivative}"


def with_space(unit: str) -> str:
    """Return a unit as it stands behind a number: ' kg', and nothing for '1'."""
    return "" if unit == "1" else f" {unit}"


NEGLIGIBLE = 1e-3  # share of terms that cancel beside which a number counts as zero


INVERSE_TOLERANCE = 1e-8  # relative response error beyond which an input of Newton's method is NaN
INVERSE_ROUNDING = 1e-15  # relative response error at which it stops, unless a step of 1e-12 of an input does before
NEWTON_ITERATIONS = 50  # CasADi's own largest number, said here because the worst case of an exported step counts it


def inverse_function(plant: Motion, response: ca.Function) -> ca.Function:
    """Return the Function (state, response of the controlled coordinates, parameters) -> input.

    A user's own inverse comes first. A response that is affine in the inputs, r = f_0 + G u, is solved by u = G^-1 (r - f_0). Any
    other one, Function (state, input, parameters), is solved by Newton's method; an input that it does not find is NaN.
    """
    if len(plant.controlled_names) != len(plant.inputs):
        raise NotInvertible(f"{len(plant.controlled_names)} controlled coordinates need as many inputs")
    if plant.inverse is not None:
        return inverse_by_user(plant, plant.inverse)
    return inverse_of_affine(plant, response) if affine(plant, response) else inverse_by_newton(plant, response)


def affine(plant: Motion, response: ca.Function) -> bool:
    """Whether the response is affine in the inputs, decided from the symbols."""
    x, u, p = plant.symbols()
    return bool(ca.is_linear(response(x, u, p), u))


def inverse_by_user(plant: Motion, inverse: Callable[..., Mapping[str, Expression]]) -> ca.Function:
    """Function (state, response, parameters) -> input, made of the user's `inverse`."""
    x, _, p = plant.symbols()
    r = ca.SX.sym("r", len(plant.controlled_names))
    wanted = Named(plant.controlled_names, r, "coordinate")
    *derivatives, parameters = by_name(plant, x, p)
    commands = named_results("inverse", called("inverse", inverse, *derivatives, wanted, parameters))
    mistakes = Mistakes("inverse")
    for name in plant.inputs:
        if name not in commands:
            mistakes.add(f"it does not give input '{name}'; return it too")
    mistakes.raise_if_any()
    entries = [
        scalar_expression(f"inverse: input '{i}'", commands[i], of=inverse, symbols=(x, r, p)) for i in plant.inputs
    ]
    column = ca.vertcat(*entries)
    return ca.Function("fpirhc_inverse", [x, r, p], [ca.densify(column)], ["x", "r", "p"], ["u"])


def inverse_of_affine(plant: Motion, response: ca.Function) -> ca.Function:
    """Function (state, response, parameters) -> input, for a response that is affine in the inputs."""
    x, u, p = plant.symbols()
    r = ca.SX.sym("r", len(plant.controlled_names))
    gain = ca.jacobian(response(x, u, p), u)
    free = response(x, ca.SX.zeros(len(plant.inputs)), p)
    column = ca.densify(ca.solve(gain, r - free))
    return ca.Function("fpirhc_inverse", [x, r, p], [column], ["x", "r", "p"], ["u"])


def inverse_by_newton(plant: Motion, response: ca.Function) -> ca.Function:
    """Function (state, response, parameters) -> input, found by Newton's method.

    It begins at zero inputs; where these have no effect, as with the square of a current, at one unit of every input: such an input
    is found where it is not much smaller than its unit.
    """
    x, u, p = plant.symbols()
    r = ca.SX.sym("r", len(plant.controlled_names))
    given = ca.SX.sym("size", r.numel()), ca.SX.sym("unit", u.numel())
    error = ca.Function("fpirhc_inversion", [u, x, r, p, *given], [(response(x, u * given[1], p) - r) / given[0]])
    options = {"error_on_fail": False, "max_iter": NEWTON_ITERATIONS, "abstol": INVERSE_ROUNDING}
    finder = ca.rootfinder("fpirhc_newton", "fast_newton", error, options)
    xm, rm, pm = (ca.MX.sym(n, s) for n, s in (("x", x.numel()), ("r", r.numel()), ("p", p.numel())))
    none, one = ca.DM.zeros(u.numel()), ca.DM.ones(u.numel())
    gain_at_zero = ca.sparsify(ca.substitute(ca.jacobian(response(x, u, p), u), u, none))
    blind = ca.sprank(gain_at_zero.sparsity()) < u.numel()
    there, unit = response(x, none, p), ca.SX(one)
    size = _size(x, r, p, there)
    if blind:  # as much as nearly no input does, whose effect is a square at least
        size += NEGLIGIBLE**2 * _finite(ca.fabs(response(x, one, p)), 0)
    else:  # of the first step, at most 1
        unit = ca.fmin(1, _finite(ca.fabs(ca.solve(gain_at_zero, r - there)), 1))
    # Where all is zero, or so small that its square is, zero inputs are the answer.
    sizes = ca.Function("fpirhc_sizes", [x, r, p], [ca.densify(v + (v**2 <= 0)) for v in (size, unit)])(xm, rm, pm)
    root = finder(one if blind else none, xm, rm, pm, *sizes)
    residual = ca.norm_inf(error(root, xm, rm, pm, *sizes))
    # NaN is on neither side of a comparison, so arriving is asked for and not missing.
    lost = ca.logic_not(residual <= INVERSE_TOLERANCE)
    column = sizes[1] * root + graph(nan_where(expression(lost)))
    return ca.Function("fpirhc_inverse", [xm, rm, pm], [column], ["x", "r", "p"], ["u"])


def _size(x: ca.SX, r: ca.SX, p: ca.SX, there: ca.SX) -> ca.SX:
    """How large each response is: what is asked, what there is without inputs, and a share of the terms that cancel there."""
    known = ca.vertcat(x, p)
    terms = ca.mtimes(ca.fabs(ca.jacobian(there, known)), ca.fabs(known))
    return ca.fabs(r) + ca.fabs(there) + NEGLIGIBLE * _finite(terms, 0)


def _finite(values: Expression, other: float) -> Expression:
    """The values, and another one in place of what is not finite."""
    return ca.vertcat(*(ca.if_else(ca.fabs(v) < FINITE, v, other) for v in ca.vertsplit(ca.densify(values))))
