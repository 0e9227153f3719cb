"""The derivatives of one coordinate up to the first that depends on an input, by Lie derivatives of the model.

With x' = f(x, u, p) and y one entry of x the chain is

    y^(0) = y,    y^(k) = d y^(k-1)/dx f(x, u, p),    k = 1 ... r,

and the relative order r is the first k for which y^(k) depends on the input. The pattern of dependence decides, not a value, so a
gain that vanishes in one state does not change the order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from fpirhc.errors import InvalidName, NotInvertible, NotSupported, nearest
from fpirhc.plant.lie_derivatives import output_expression, structural_order
from fpirhc.plant.motion import followed_units
from fpirhc.plant.plant import Plant
from fpirhc.plant.units import derivative_unit


@dataclass(frozen=True, eq=False)
class OutputChain:
    """One coordinate's derivatives up to its relative order.

    Args:
        coordinate: its name.
        input: name of the input.
        unit: of the coordinate.
        order: the relative order r.
        response_unit: of y^(r).
        states: Function (state, parameters) -> (y, y', ..., y^(r-1)), shape (r,).
        response: Function (state, input, parameters, forcing) -> y^(r), scalar; `forcing` adds to the plant's responses.
        gain: Function (state, input, parameters) -> d y^(r) / d input, scalar.
    """

    coordinate: str
    input: str
    unit: str
    order: int
    response_unit: str
    states: ca.Function
    response: ca.Function
    gain: ca.Function

    @cached_property
    def affine(self) -> bool:
        """Whether y^(r) is affine in the input, decided from the symbols."""
        x, u, p = (ca.SX.sym("v", self.gain.size1_in(k)) for k in range(3))
        return not ca.depends_on(self.gain(x, u, p), u)


def output_chain(plant: Plant, coordinate: str, input_name: str | None = None) -> OutputChain:
    """Return the chain from a coordinate to an input; `input_name` may be None where the plant has one input.

    Raises:
        InvalidName: an unknown coordinate or input, or no name although there are several inputs.
        NotInvertible: the input reaches no derivative of the coordinate, or another input reaches an earlier one.
        NotSupported: a map.
    """
    name = _input(plant, coordinate, input_name)
    if plant.step is not None:
        raise NotSupported(
            "output_chain differentiates with respect to time, which a map does not have; write an output, whose differences and "
            "order are those of `Plant.equations.output_orders` and `Plant.equations.output`"
        )
    x, u, p = plant.symbols()
    w = ca.SX.sym("w", len(plant.names))
    rate = plant.equations.forced_rate(x, u, p, w)
    command = u[plant.input.elements.index(name)]
    first = [x[plant.state.elements.index(coordinate)]] if coordinate in plant.coordinates else []
    derivatives = first or [output_expression(plant, coordinate, x, u, p)]
    if ca.jacobian_sparsity(derivatives[0], u).nnz():
        raise NotInvertible(
            f"the command moves '{coordinate}' at once (order 0), so a slot has no derivative to prescribe"
        )
    for order in range(1, plant.state.size + 1):
        derivative = ca.jtimes(derivatives[-1], x, rate)
        if ca.jacobian_sparsity(derivative, command).nnz():
            return _chain(plant, coordinate, name, derivatives, derivative, (x, u, p, w))
        if ca.depends_on(derivative, u):
            others = [e for k, e in enumerate(plant.inputs) if ca.jacobian_sparsity(derivative, u[k]).nnz()]
            raise NotInvertible(
                f"derivative {order} of '{coordinate}' is reached by another input than '{name}'; choose input='{others[0]}'"
            )
        derivatives.append(derivative)
    orders = ", ".join(f"{c} {structural_order(plant, c) or 'none'}" for c in plant.names)
    raise NotInvertible(
        f"input '{name}' does not reach coordinate '{coordinate}', however often it is differentiated "
        f"(relative order by coordinate: {orders}); choose a coordinate that has one"
    )


def _input(plant: Plant, coordinate: str, name: str | None) -> str:
    followed = followed_units(plant)
    if coordinate not in followed:
        raise InvalidName(f"coordinate '{coordinate}' is unknown.{nearest(coordinate, followed)}")
    if name is None:
        if len(plant.inputs) > 1:
            raise InvalidName(f"'{coordinate}' needs the name of its input. Valid: {', '.join(plant.inputs)}.")
        return next(iter(plant.inputs))
    if name not in plant.inputs:
        raise InvalidName(f"input '{name}' is unknown.{nearest(name, plant.inputs)}")
    return name


def _chain(
    plant: Plant,
    coordinate: str,
    name: str,
    derivatives: list[ca.SX],
    response: ca.SX,
    symbols: tuple[ca.SX, ca.SX, ca.SX, ca.SX],
) -> OutputChain:
    x, u, p, w = symbols
    place, unit = plant.input.elements.index(name), followed_units(plant)[coordinate]
    # A model gives y ... y^(r-1) and the gain without disturbances.
    undisturbed = [ca.densify(ca.substitute(v, w, ca.SX.zeros(*w.shape))) for v in (ca.vertcat(*derivatives), response)]
    gain = ca.densify(ca.jacobian(undisturbed[1], u[place]))
    return OutputChain(
        coordinate,
        name,
        unit,
        len(derivatives),
        derivative_unit(unit, len(derivatives), plant.time_unit),
        ca.Function("fpirhc_chain", [x, p], [undisturbed[0]]),
        ca.Function("fpirhc_chain_response", [x, u, p, w], [ca.densify(response)]),
        ca.Function("fpirhc_chain_gain", [x, u, p], [gain]),
    )
