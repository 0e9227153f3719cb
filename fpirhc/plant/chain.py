"""Derivatives of a plant's coordinates and outputs as functions of its state: the Lie derivatives y, y', y'', ... along its motion.

    y_0 = the quantity,        y_{k+1} = dy_k/dx x'(x, u, p, w),

with the input u and the forcing w held, as they are over a control cycle. A derivative that is a state or a response of the
plant is that entry itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from fpirhc.plant.lie_derivatives import Symbols, lie_derivatives, output_expression
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression


def derivatives_function(plant: Plant, wanted: Sequence[tuple[str, int]]) -> ca.Function:
    """Return the Function (state, input, parameters, forcing) -> the wanted derivatives, in their order.

    Args:
        plant: the plant.
        wanted: (coordinate or output, number of the derivative) of every entry.
    """
    x, u, p = plant.symbols()
    w = ca.SX.sym("w", len(plant.names))
    most = {name: max(k for n, k in wanted if n == name) for name, _ in wanted}
    responses = _responses(plant, (x, u, p, w))
    chains = {name: _chain(plant, name, count, (x, u, p, w), responses) for name, count in most.items()}
    column = ca.vertcat(*(chains[name][k] for name, k in wanted))
    return ca.Function("fpirhc_derivatives", [x, u, p, w], [ca.densify(column)])


def input_reaches_at(plant: Plant, name: str, count: int) -> int | None:
    """Return the first derivative of a quantity that depends on an input at once; None where none up to `count` does."""
    x, u, p = plant.symbols()
    symbols = x, u, p, ca.SX.sym("w", len(plant.names))
    chain = _chain(plant, name, count, symbols, _responses(plant, symbols))
    return next((k for k, y in enumerate(chain) if ca.depends_on(y, u)), None)


def _responses(plant: Plant, symbols: Symbols) -> Expression:
    """The highest derivatives of all coordinates; a map has none."""
    x, u, p, w = symbols
    return w if plant.step is not None else plant.response_function(x, u, p) + w


def _chain(plant: Plant, name: str, count: int, symbols: Symbols, responses: Expression) -> list[Expression]:
    """The coordinate or output and its first `count` derivatives."""
    x, u, p, w = symbols
    if name not in plant.coordinates:
        return lie_derivatives(plant, output_expression(plant, name, x, u, p), count, (x, u, p, w))
    elements, place = plant.state.elements, plant.names.index(name)
    if plant.step is not None:
        return lie_derivatives(plant, x[place], count, (x, u, p, w))
    order = plant.orders[place]
    chain = [x[elements.index(name + "'" * k)] for k in range(min(order, count + 1))]
    if count >= order:
        chain.append(responses[place])
    if count > order:
        rate = plant.forced_derivative_function(x, u, p, w)
        for _ in range(count - order):
            chain.append(ca.jtimes(chain[-1], x, rate))
    return chain
