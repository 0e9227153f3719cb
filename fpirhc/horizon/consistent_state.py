"""The state of the model at which its outputs and their derivatives are the measured ones, y^(j) = h_j(x*, p), j < r.

Theory: docs/theory-plants.md.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from fpirhc.plant.plant import Plant

_STEPS = 4
_GOOD, _POOR = 0.25, 0.5  # last step by the first: up to here the state is found, and from here on it stays
_INSIDE = 0.99  # of the way to the end of a physical range, where a model may have no slope


def consistent_state(plant: Plant) -> ca.Function:
    """Return the Function (state, outputs, parameters) -> state at which the model has the controlled ones of these outputs.

    Args:
        plant: the model, with outputs. The command moves those of order 0 at once, so no state has them, and they are left out.
    """
    start, y, p = (
        ca.MX.sym("x", plant.state.size),
        ca.MX.sym("y", plant.output.size),
        ca.MX.sym("p", plant.parameter.size),
    )
    orders = plant.response_orders
    if not any(orders.values()):  # nothing but outputs that the command moves at once
        return ca.Function("fpirhc_consistent_state", [start, y, p], [start], ["x", "y", "p"], ["found"])
    newton = _newton(plant, orders)
    x, sizes = start, []
    for _ in range(_STEPS):
        move, size = newton(x, y, p)
        x = x + move
        sizes.append(size)
    found = _trusted(plant)(start, x, sizes[0], sizes[-1])
    return ca.Function("fpirhc_consistent_state", [start, y, p], [found], ["x", "y", "p"], ["found"])


def _trusted(plant: Plant) -> ca.Function:
    """Function (start, end, size of the first step, of the last) -> as far from start to end as contraction and ranges let it."""
    count = plant.state.size
    start, end = ca.SX.sym("start", count), ca.SX.sym("end", count)
    first, last = ca.SX.sym("first"), ca.SX.sym("last")
    whole = (_POOR - _GOOD) * ca.if_else(first > 0, first, 1)
    share = ca.fmax(0, ca.fmin(1, (_POOR * first - last) / whole))
    for name, (lowest, highest) in plant.ranges.items():
        k = plant.state.elements.index(name)
        way = end[k] - start[k]
        room = _INSIDE * ca.fmax(0, ca.if_else(way > 0, highest - start[k], start[k] - lowest))
        leaves = ca.fabs(way) > room
        share = ca.fmin(share, ca.if_else(leaves, room / ca.if_else(leaves, ca.fabs(way), 1), 1))
    # What is not a number compares as false.
    reached = ca.if_else(share < 1, start + share * (end - start), end)
    found = ca.if_else(last <= _POOR * first, reached, start)
    return ca.Function("fpirhc_trusted_state", [start, end, first, last], [found])


def _newton(plant: Plant, orders: Mapping[str, int]) -> ca.Function:
    """Function (state, outputs, parameters) -> (move of the state, sum of the inputs' pulses that would have made it)."""
    x, _, p = plant.symbols()
    y = ca.SX.sym("y", plant.output.size)
    rows = [k for k, e in enumerate(plant.output.elements) if orders.get(e.rstrip("'"), 0)]
    outputs = plant.equations.output(x, ca.SX.zeros(len(plant.inputs)), p, ca.SX.zeros(len(plant.names)))[rows]
    basis, pulses = _basis(plant, x, p, list(orders.values()))
    seen = ca.mtimes(ca.jacobian(outputs, x), basis)
    c = ca.solve(ca.densify(seen), y[rows] - outputs)
    size = ca.sum1(ca.fabs(ca.mtimes(pulses, c)))  # a maximum would skip what is not a number
    return ca.Function("fpirhc_newton_of_outputs", [x, y, p], [ca.densify(ca.mtimes(basis, c)), ca.densify(size)])


def _basis(plant: Plant, x: ca.SX, p: ca.SX, orders: list[int]) -> tuple[ca.SX, ca.SX]:
    """The directions, a column per order of every output; and the inputs of each, one below the other by k."""
    still, u = ca.SX.zeros(len(plant.inputs)), ca.SX.sym("u", len(plant.inputs))
    drift, moved = plant.equations.rate(x, still, p), plant.equations.rate(x, u, p)
    alone = ca.SX.eye(len(orders))
    if len(set(orders)) > 1:
        slope = ca.substitute(ca.jacobian(plant.equations.controlled_response(x, u, p), u), u, still)
        alone = ca.solve(ca.densify(slope), alone)
    field = ca.substitute(ca.jacobian(moved, u), u, still)
    columns, pulses = [], []
    for k in range(max(orders)):
        chosen = alone[:, [j for j, order in enumerate(orders) if order > k]]
        columns.append(ca.mtimes(field, chosen))
        pulses.append(chosen)
        field = ca.horzcat(*(ca.jtimes(drift, x, g) - ca.jtimes(g, x, drift) for g in ca.horzsplit(field)))
    return ca.horzcat(*columns), ca.diagcat(*pulses)
