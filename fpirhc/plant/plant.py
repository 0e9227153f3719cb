"""The plant: coordinates, inputs, relative order, response, and two sets of parameters side by side.

A plant is given by its response: the highest derivative q^(r) of every coordinate as a CasADi expression of the lower
derivatives, the inputs u and the parameters p,

    q_i^(r_i) = f_i(q, q', ..., u, p).

The controller computes with the approximate parameters, the simulated plant with the exact ones. The state vector is
derivative-major: all q, then the q' of the coordinates with order >= 2, and so on; its entries are named q1, q1', q1''.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError, Mistakes, NotInvertible
from fpirhc.symbolic.layout import Expression, Named, Signal, vector

INVERSE_TOLERANCE = 1e-8  # relative response error beyond which a numerically found input counts as not found


@dataclass(frozen=True)
class Parameter:
    """One parameter: the value the model believes, the value the plant has, their unit, and what is physically possible."""

    approximate: float
    exact: float
    unit: str
    bounds: tuple[float, float] = (-math.inf, math.inf)


@dataclass(frozen=True, eq=False)
class Plant:
    """A system q^(r) = f(q, q', ..., u, p), known to the controller with approximate parameters only.

    Parameters:
        coordinates: name -> unit of every coordinate.
        inputs: name -> unit of every input.
        parameters: name -> Parameter(approximate, exact, unit).
        response: function of (q, q', ..., u, p), one argument per derivative below the highest order, each with its
            entries by name (`q.q1`); returns {coordinate: its highest derivative}.
        order: relative order r, one number or {coordinate: number}.
        controlled: the coordinates that a tracking law and a deformation act on, as many as there are inputs; needed
            only when there are fewer inputs than coordinates.
        inverse: optional function of (q, q', ..., r, p) that returns {input: command} for wanted responses r of the
            controlled coordinates. Without it the inverse is derived when the response is affine in the inputs, and
            found by Newton's method otherwise.

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

    def __post_init__(self) -> None:
        mistakes = Mistakes("plant")
        _check_names(self, mistakes)
        _check_parameters(self.parameters, mistakes)
        mistakes.raise_if_any()
        _check_response(self, mistakes)
        mistakes.raise_if_any()

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
        names, units = [], []
        for k in range(max(self.orders)):
            for c, r in zip(self.names, self.orders, strict=True):
                if r > k:
                    names.append(c + "'" * k)
                    units.append(derivative_unit(self.coordinates[c], k))
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
    def controlled_names(self) -> tuple[str, ...]:
        """The coordinates that tracking and deformation act on.

        Raises:
            NotInvertible: fewer inputs than coordinates and no choice made.
        """
        if self.controlled is not None:
            return tuple(self.controlled)
        if len(self.inputs) != len(self.coordinates):
            raise NotInvertible(
                f"{len(self.inputs)} input(s) cannot prescribe {len(self.coordinates)} coordinates: name the "
                f"controlled ones, as many as there are inputs: Plant(..., controlled=({self.names[0]!r},))"
            )
        return self.names

    @cached_property
    def controlled_indices(self) -> tuple[int, ...]:
        """Places of the controlled coordinates among all coordinates."""
        return tuple(self.names.index(c) for c in self.controlled_names)

    @cached_property
    def response_units(self) -> tuple[str, ...]:
        """Units of the highest derivative of every coordinate."""
        return tuple(derivative_unit(u, r) for u, r in zip(self.coordinates.values(), self.orders, strict=True))

    def response_signal(self, name: str) -> Signal:
        """Return a signal that holds a highest derivative of every controlled coordinate."""
        units = [self.response_units[k] for k in self.controlled_indices]
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
        """Return the plant with other exact parameters, shape (np,); what was derived from the symbols is shared.

        Raises:
            InvalidProblem: a parameter that is not finite or outside its bounds.
        """
        named = zip(self.parameters.items(), exact, strict=True)
        parameters = {name: replace(parameter, exact=float(value)) for (name, parameter), value in named}
        mistakes = Mistakes("plant")
        _check_parameters(parameters, mistakes)
        mistakes.raise_if_any()
        other = copy(self)
        # Nothing else that is kept depends on the exact values.
        other.__dict__.pop("exact", None)
        object.__setattr__(other, "parameters", parameters)
        return other

    def indices(self, derivative: int) -> tuple[int, ...]:
        """Places in the state vector of the given derivative, coordinate by coordinate (order > derivative only)."""
        wanted = [c + "'" * derivative for c, r in zip(self.names, self.orders, strict=True) if r > derivative]
        return tuple(self.state.elements.index(e) for e in wanted)

    @cached_property
    def response_function(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of every coordinate (n)."""
        x, u, p = self._symbols()
        given = self.response(*self._derivatives(x), Named(self.input.elements, u, "input"), self._parameters(p))
        column = ca.vertcat(*(ca.SX(given[c]) for c in self.names))
        return ca.Function("fpirhc_response", [x, u, p], [ca.densify(column)], ["x", "u", "p"], ["r"])

    @cached_property
    def controlled_response_function(self) -> ca.Function:
        """Function (state, input, parameters) -> highest derivative of the controlled coordinates."""
        x, u, p = self._symbols()
        chosen = self.response_function(x, u, p)[list(self.controlled_indices)]
        return ca.Function("fpirhc_controlled_response", [x, u, p], [chosen], ["x", "u", "p"], ["r"])

    @cached_property
    def forced_derivative_function(self) -> ca.Function:
        """Function (state, input, parameters, forcing) -> dx/dt; `forcing` (n) adds to the responses."""
        x, u, p = self._symbols()
        w = ca.SX.sym("w", len(self.names))
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
        x, u, p = self._symbols()
        rate = self.forced_derivative_function(x, u, p, ca.SX.zeros(len(self.names)))
        return ca.Function("fpirhc_free_derivative", [x, u, p], [rate], ["x", "u", "p"], ["xdot"])

    @cached_property
    def affine(self) -> bool:
        """Whether the controlled response is affine in the inputs, decided from the symbols."""
        x, u, p = self._symbols()
        return bool(ca.is_linear(self.controlled_response_function(x, u, p), u))

    @property
    def inverse_opaque(self) -> bool:
        """Whether the inverse response needs a root finder, which scalar expressions cannot hold."""
        return self.inverse is None and not self.affine

    @cached_property
    def inverse_function(self) -> ca.Function:
        """Function (state, response of the controlled coordinates, parameters) -> input.

        An input that Newton's method does not find is NaN, never a wrong number.

        Raises:
            NotInvertible: the inputs and the controlled coordinates differ in number.
        """
        if len(self.controlled_names) != len(self.inputs):
            raise NotInvertible(f"{len(self.controlled_names)} controlled coordinates need as many inputs")
        if self.inverse is not None:
            return self._given_inverse(self.inverse)
        return self._affine_inverse() if self.affine else self._found_inverse()

    def _given_inverse(self, inverse: Callable[..., Mapping[str, Expression]]) -> ca.Function:
        x, _, p = self._symbols()
        r = ca.SX.sym("r", len(self.controlled_names))
        given = inverse(*self._derivatives(x), Named(self.controlled_names, r, "coordinate"), self._parameters(p))
        column = ca.vertcat(*(ca.SX(given[i]) for i in self.inputs))
        return ca.Function("fpirhc_inverse", [x, r, p], [ca.densify(column)], ["x", "r", "p"], ["u"])

    def _affine_inverse(self) -> ca.Function:
        x, u, p = self._symbols()
        r = ca.SX.sym("r", len(self.controlled_names))
        response = self.controlled_response_function(x, u, p)
        gain = ca.jacobian(response, u)
        free = self.controlled_response_function(x, ca.SX.zeros(len(self.inputs)), p)
        column = ca.densify(ca.solve(gain, r - free))
        return ca.Function("fpirhc_inverse", [x, r, p], [column], ["x", "r", "p"], ["u"])

    def _found_inverse(self) -> ca.Function:
        x, u, p = self._symbols()
        r = ca.SX.sym("r", len(self.controlled_names))
        error = ca.Function("fpirhc_inversion", [u, x, r, p], [self.controlled_response_function(x, u, p) - r])
        finder = ca.rootfinder("fpirhc_newton", "fast_newton", error, {"error_on_fail": False})
        xm, rm, pm = (ca.MX.sym(n, s) for n, s in (("x", x.numel()), ("r", r.numel()), ("p", p.numel())))
        found = finder(ca.DM.zeros(len(self.inputs)), xm, rm, pm)
        residual = ca.norm_inf(error(found, xm, rm, pm))
        good = residual <= INVERSE_TOLERANCE * (1 + ca.norm_inf(rm))
        return ca.Function("fpirhc_inverse", [xm, rm, pm], [ca.if_else(good, found, math.nan)], ["x", "r", "p"], ["u"])

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        return (ca.SX.sym("x", self.state.size), ca.SX.sym("u", len(self.inputs)), ca.SX.sym("p", len(self.parameters)))

    def _derivatives(self, x: Expression) -> list[Named]:
        views = []
        for k in range(max(self.orders)):
            holders = [c for c, r in zip(self.names, self.orders, strict=True) if r > k]
            views.append(Named(holders, x[list(self.indices(k))], "coordinate"))
        return views

    def _parameters(self, p: Expression) -> Named:
        return Named(tuple(self.parameters), p, "parameter")


def derivative_unit(unit: str, derivative: int) -> str:
    """Return the unit of a time derivative: 'm' -> 'm/s' -> 'm/s^2'."""
    if derivative == 0:
        return unit
    return f"{unit}/s" if derivative == 1 else f"{unit}/s^{derivative}"


def structural_order(plant: Plant, coordinate: str) -> int | None:
    """Return how many derivatives of `coordinate` it takes until some input appears; None if none ever does.

    Only the pattern of dependence is used (a breadth-first walk from the coordinate through the states its
    derivatives depend on), so accidental cancellations do not show.
    """
    x, u, p = plant._symbols()
    rate = plant.derivative_function(x, u, p)
    on_state = np.array(ca.DM(ca.jacobian_sparsity(rate, x), 1).full(), dtype=bool)
    on_input = np.array(ca.DM(ca.jacobian_sparsity(rate, u), 1).full(), dtype=bool).any(axis=1)
    reached: np.ndarray = np.zeros(plant.state.size, dtype=bool)
    reached[plant.state.elements.index(coordinate)] = True
    for order in range(1, plant.state.size + 1):
        if bool((reached & on_input).any()):
            return order
        reached = np.asarray(on_state[reached].any(axis=0))
    return None


def _check_names(plant: Plant, mistakes: Mistakes) -> None:
    for what, group in (("coordinates", plant.coordinates), ("inputs", plant.inputs)):
        if not group:
            mistakes.add(f"{what} are empty; name at least one, with its unit")
        for name, unit in group.items():
            if not isinstance(unit, str) or not unit:
                mistakes.add(f"{what}: '{name}' has no unit; write {{'{name}': 'm'}} (or '1' for none)")
            if not str(name).isidentifier():
                mistakes.add(f"{what}: '{name}' is not an identifier; use letters, digits and underscores")
    every = [*plant.coordinates, *plant.inputs]
    for name in sorted({n for n in every if every.count(n) > 1}):
        mistakes.add(f"'{name}' names both a coordinate and an input; rename one")
    _check_order_numbers(plant, mistakes)
    if plant.controlled is not None:
        mistakes.unknown("controlled: coordinate", plant.controlled, plant.coordinates)
        if len(plant.controlled) != len(plant.inputs):
            mistakes.add(
                f"controlled names {len(plant.controlled)} coordinate(s), but {len(plant.inputs)} input(s) "
                "can prescribe exactly as many"
            )


def _check_order_numbers(plant: Plant, mistakes: Mistakes) -> None:
    if isinstance(plant.order, Mapping):
        mistakes.unknown("order: coordinate", plant.order, plant.coordinates)
        for c in plant.coordinates:
            if c not in plant.order:
                mistakes.add(f"order: coordinate '{c}' has none; add '{c}': 2 (the derivative that the response gives)")
    orders = plant.order.values() if isinstance(plant.order, Mapping) else [plant.order]
    for order in orders:
        if not isinstance(order, int) or isinstance(order, bool) or order < 1:
            mistakes.add(f"order must be a whole number of at least 1, got {order!r}")


def _check_parameters(parameters: Mapping[str, Parameter], mistakes: Mistakes) -> None:
    for name, parameter in parameters.items():
        if not isinstance(parameter, Parameter):
            mistakes.add(f"parameter '{name}' must be Parameter(approximate=..., exact=..., unit=...)")
            continue
        numbers = True
        for which in ("approximate", "exact"):
            value = getattr(parameter, which)
            if not isinstance(value, int | float) or not math.isfinite(value):
                mistakes.add(f"parameter '{name}': {which} must be a finite number, got {value!r}")
                numbers = False
        mistake = _bounds_mistake(parameter) if numbers else ""
        if mistake:
            mistakes.add(f"parameter '{name}': {mistake}")
        if not isinstance(parameter.unit, str) or not parameter.unit:
            mistakes.add(f"parameter '{name}' has no unit; write unit='kg' (or '1' for none)")


def _bounds_mistake(parameter: Parameter) -> str:
    try:
        low, high = map(float, parameter.bounds)
    except (TypeError, ValueError):
        return f"bounds must be a pair of numbers (lowest, highest), got {parameter.bounds!r}"
    if not low < high:
        return f"bounds must be (lowest, highest), got {parameter.bounds!r}"
    outside = [w for w in ("approximate", "exact") if not low <= getattr(parameter, w) <= high]
    return f"{outside[0]} is outside its bounds {parameter.bounds!r}" if outside else ""


def _check_response(plant: Plant, mistakes: Mistakes) -> None:
    expected = max(plant.orders) + 2
    taken = len(inspect.signature(plant.response).parameters)
    if taken != expected:
        lower = ["q", "v", "a"] + [f"d{k}" for k in range(3, 12)]
        mistakes.add(
            f"response takes {taken} argument(s); with order {max(plant.orders)} it is called as "
            f"response({', '.join([*lower[: expected - 2], 'u', 'p'])})"
        )
        return
    x, u, p = plant._symbols()
    try:
        given = plant.response(*plant._derivatives(x), Named(plant.input.elements, u, "input"), plant._parameters(p))
    except FpirhcError as error:
        mistakes.add(f"response: {error}")
        return
    if not isinstance(given, Mapping):
        mistakes.add(f"response must return {{coordinate: expression}}, got {type(given).__name__}")
        return
    mistakes.unknown("response: coordinate", given, plant.coordinates)
    for c, r in zip(plant.names, plant.orders, strict=True):
        if c not in given:
            mistakes.add(f"response does not give the derivative {c}{chr(39) * r} of coordinate '{c}'; return it too")
        elif ca.SX(given[c]).numel() != 1:
            mistakes.add(f"response of '{c}' must be one scalar, got shape {ca.SX(given[c]).shape}")
    if all(c in given and ca.SX(given[c]).numel() == 1 for c in plant.names):
        _check_orders(plant, mistakes)


def _check_orders(plant: Plant, mistakes: Mistakes) -> None:
    if plant.controlled is None and len(plant.inputs) != len(plant.coordinates):
        return
    for k in plant.controlled_indices:
        name, said = plant.names[k], plant.orders[k]
        found = structural_order(plant, name)
        if found is None:
            mistakes.add(f"no input reaches coordinate '{name}', however often it is differentiated")
        elif found != said:
            mistakes.add(
                f"order of '{name}' is given as {said}, but its response has no input: the first derivative that an "
                f"input reaches is number {found}. Write the response of order {found}, or control another coordinate"
            )
