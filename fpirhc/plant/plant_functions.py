"""What a plant is as CasADi Functions of its state, input and parameters, made from its symbols.

With the state x = (q, q', ...), derivative-major, and a forcing w that adds to the highest derivatives,

    response    r = f(x, u, p),        algebraic states    z(x, u, p),        x' = (q', q'', ..., f(x, u, p) + w).

Those of a map are its divided differences over one control cycle; see `fpirhc.plant.maps`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from fpirhc.fields.user_code import called
from fpirhc.symbolic.layout import Expression, Named

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


def by_name(plant: Plant, x: Expression, p: Expression) -> tuple[Named, ...]:
    """Return the arguments of a user's function without the inputs, each with its entries by name: q, q', ..., p."""
    derivatives = [
        Named(
            [c for c, r in zip(plant.names, plant.orders, strict=True) if r > k],
            x[list(plant.indices(k))],
            plant.words[0],
        )
        for k in range(max(plant.orders, default=0))
    ]
    return (*derivatives, Named(tuple(plant.parameters), p, "parameter"))


def response_function(plant: Plant) -> ca.Function:
    """Return the Function (state, input, parameters) -> highest derivative of every coordinate (n)."""
    x, u, p = plant.symbols()
    if plant.next is not None:
        differences = (plant.next_function(x, u, p, ca.SX.zeros(len(plant.names))) - x) / plant.sampling
        return ca.Function("fpirhc_response", [x, u, p], [differences], ["x", "u", "p"], ["r"])
    views = plant.views(x, u, p)
    if plant.algebraic is not None:
        views = (*views, plant.algebraic.view(plant.algebraic_function(x, u, p)))
    responses = called(plant.words[1], plant.response, *views)
    column = ca.vertcat(*(ca.SX(responses[c]) for c in plant.names))
    return ca.Function("fpirhc_response", [x, u, p], [ca.densify(column)], ["x", "u", "p"], ["r"])


def algebraic_function(plant: Plant) -> ca.Function:
    """Return the Function (state, input, parameters) -> algebraic states (nz); empty without any."""
    x, u, p = plant.symbols()
    solution = ca.SX(0, 1)
    if plant.algebraic is not None:
        solution = plant.algebraic.solved(plant.views(x, u, p), ca.vertcat(x, u, p))
    return ca.Function("fpirhc_algebraic", [x, u, p], [ca.densify(solution)], ["x", "u", "p"], ["z"])


def forced_derivative_function(plant: Plant) -> ca.Function:
    """Return the Function (state, input, parameters, forcing) -> dx/dt; `forcing` (n) adds to the responses."""
    x, u, p = plant.symbols()
    w = ca.SX.sym("w", len(plant.names))
    if plant.next is not None:
        differences = (plant.next_function(x, u, p, w) - x) / plant.sampling
        return ca.Function("fpirhc_derivative", [x, u, p, w], [differences], ["x", "u", "p", "w"], ["xdot"])
    responses = plant.response_function(x, u, p) + w
    rates = []
    for element in plant.state.elements:
        higher = element + "'"
        if higher in plant.state.elements:
            rates.append(x[plant.state.elements.index(higher)])
        else:
            rates.append(responses[plant.names.index(element.rstrip("'"))])
    return ca.Function("fpirhc_derivative", [x, u, p, w], [ca.vertcat(*rates)], ["x", "u", "p", "w"], ["xdot"])


def derivative_function(plant: Plant) -> ca.Function:
    """Return the Function (state, input, parameters) -> dx/dt, undisturbed."""
    x, u, p = plant.symbols()
    rate = plant.forced_derivative_function(x, u, p, ca.SX.zeros(len(plant.names)))
    return ca.Function("fpirhc_free_derivative", [x, u, p], [rate], ["x", "u", "p"], ["xdot"])
