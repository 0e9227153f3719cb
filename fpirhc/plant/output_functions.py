"""What is measured and prescribed of a plant as CasADi Functions: its outputs with their derivatives, and their responses.

Without outputs they are those of the coordinates: the state, and the highest derivatives of the controlled coordinates.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from fpirhc.plant.instant import response_orders
from fpirhc.plant.outputs import believed_disturbance, lie_derivatives, output_expression

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


def output_function(plant: Plant) -> ca.Function:
    """Return the Function (state, input, parameters, forcing) -> y, y', ... of the face; without outputs the state."""
    x, u, p = plant.symbols()
    w = ca.SX.sym("w", len(plant.names))
    chains = {
        name: lie_derivatives(plant, output_expression(plant, name, x, u, p), order, (x, u, p, w))
        for name, order in zip(plant.face.names, plant.face.orders, strict=True)
        if plant.outputs
    }
    entries = [chains[e.rstrip("'")][e.count("'")] for e in plant.output.elements] if plant.outputs else [x]
    return ca.Function("fpirhc_outputs", [x, u, p, w], [ca.densify(ca.vertcat(*entries))], ["x", "u", "p", "w"], ["y"])


def known_by_outputs(plant: Plant) -> tuple[int, ...]:
    """Return for every entry of the state its place among y, y', ...; -1 where it is none of these."""
    x, u, p = plant.symbols()
    if not plant.outputs:
        return tuple(range(plant.state.size))
    entries = ca.vertsplit(plant.output_function(x, u, p, ca.SX.zeros(len(plant.names))))
    equal = [[k for k, e in enumerate(entries) if ca.is_equal(e, x[i], 1)] for i in range(x.numel())]
    return tuple(places[0] if places else -1 for places in equal)


def controlled_response_function(plant: Plant) -> ca.Function:
    """Return the Function (state, input, parameters) -> highest derivative of the controlled coordinates or outputs.

    The response of an output of order 0 is the output.
    """
    x, u, p = plant.symbols()
    if plant.outputs:
        calm = ca.SX.zeros(len(plant.names))
        chains = {
            name: lie_derivatives(plant, output_expression(plant, name, x, u, p), order, (x, u, p, calm))
            for name, order in response_orders(plant).items()
        }
        entries = (chain[-1] + believed_disturbance(plant, name, p) for name, chain in chains.items())
        responses = ca.densify(ca.vertcat(*entries))
    else:
        responses = plant.response_function(x, u, p)[list(plant.controlled_indices)]
    return ca.Function("fpirhc_controlled_response", [x, u, p], [responses], ["x", "u", "p"], ["r"])
