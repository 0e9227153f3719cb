"""The model on the reference: its state where the reference gives it, else a simulation with the feedforward.

A state that is an output, or a derivative of one, has a reference. Inner states have none. Along a horizon they are simulated from
the start, x_{i+1} = F(x_i, u_i), with the input that the model needs for the nominal response, u_i = inverse(x_i, y^(r),N_i).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import require
from fpirhc.plant.chain import nominal_responses
from fpirhc.plant.integrators import Integrator
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Matrix
from fpirhc.task.reference import Reference

_CYCLES = 20_000  # of a run that are looked at
_DECAYS = 20.0  # times in a run, by which the error of the start decays
_FASTEST = 0.1  # of the cycle, the rate of this decay


def reference_state(plant: Plant, outputs: Matrix) -> Matrix:
    """Return the state on the reference, from the nominal outputs and their derivatives."""
    hidden = plant.equations.hidden
    require(
        not hidden,
        f"the input along the reference needs the states {', '.join(hidden)}, which are no outputs, and so have no "
        "reference; weigh the rate of the input, Quadratic(rate=...), in place of "
        "its deviation from a feedforward",
    )
    return plant.equations.state_of(outputs, outputs)


def feedforward(plant: Plant, outputs: Matrix, responses: Matrix, p: Matrix) -> Matrix:
    """Return the input that the model needs along the reference, where every state is an output."""
    return plant.equations.inverse(reference_state(plant, outputs), nominal_responses(plant, outputs, responses), p)


def output_feedback(plant: Plant, x: Matrix, outputs: Matrix, p: Matrix, rate: float) -> Matrix:
    """Return sum_{k<r} C(r, k) rate^(r-k) e^(k) of every controlled output, with which its error decays; 0 for order 0."""
    calm = ca.DM.zeros(len(plant.names))
    error = outputs - plant.equations.output(x, ca.DM.zeros(plant.input.size), p, calm)
    sums = []
    for name, order in plant.response_orders.items():
        places = [plant.output.elements.index(name + "'" * k) for k in range(order)]
        sums.append(sum(math.comb(order, k) * rate ** (order - k) * error[place] for k, place in enumerate(places)))
    return ca.vertcat(*sums)


def nominal_motion(
    plant: Plant,
    reference: Reference,
    advance: ca.Function,
    start: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    times: np.ndarray,
    rate: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return states (nx, m) and inputs (nu, m) of the model on its outputs' reference; errors decay as (d/dt + rate)^r e = 0."""
    x, outputs, r = (ca.MX.sym(n, size) for n, size in _sizes(plant).items())
    at, p = plant.equations.state_of(outputs, x), ca.MX(ca.DM(plant.approximate))
    feedback = output_feedback(plant, at, outputs, p, rate)
    needed = plant.equations.inverse(at, nominal_responses(plant, outputs, r) + feedback, p)
    command = ca.fmin(ca.fmax(needed, ca.DM(bounds[0])), ca.DM(bounds[1]))
    step = ca.Function("fpirhc_nominal", [x, outputs, r], [advance(at, command, p), at, command])
    outputs_at, responses_at = reference.function(plant).map(times.size)(times[None, :])
    _, states, inputs = step.mapaccum(times.size)(start, outputs_at, responses_at)
    return np.asarray(states.full()), np.asarray(inputs.full())


def _sizes(plant: Plant) -> dict[str, int]:
    return {"x": plant.state.size, "outputs": plant.output.size, "r": len(plant.chains)}


Bounds: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]


@lru_cache(maxsize=8)  # studies make many problems of one plant and reference
def nominal_run(
    plant: Plant,
    reference: Reference,
    integrator: Integrator,
    start: tuple[float, ...],
    bounds: Bounds,
    times: tuple[float, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Return states (nx, m) and inputs (nu, m) of the model that follows the reference of its outputs for 20 000 cycles."""
    period, cycles = times[0], min(times[1], _CYCLES)
    x, u, p = plant.symbols()
    advance, w = integrator.step(plant, period), np.zeros(len(plant.names))
    xm, um, pm = (ca.MX.sym(n, v.numel()) for n, v in (("x", x), ("u", u), ("p", p)))
    step = ca.Function("fpirhc_advance", [xm, um, pm], [advance(xm, um, pm, w)])
    rate = min(_DECAYS / (period * times[1]), _FASTEST / period)
    ends = np.array(bounds[0]), np.array(bounds[1])
    return nominal_motion(plant, reference, step, np.array(start), ends, period * np.arange(cycles), rate)


_STEPS = 4
_GOOD, _POOR = 0.25, 0.5  # last step by the first: up to here the state is found, and from here on it stays
_INSIDE = 0.99  # of the way to the end of a physical range, where a model may have no slope


def consistent_state(plant: Plant) -> ca.Function:
    """Return the Function (state, outputs, parameters) -> state x* at which the model has these outputs, y^(j) = h_j(x*, p), j < r.

    The command moves outputs of order 0 at once, so no state has them, and they are left out. Theory: docs/theory.md.
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
    trusted = _trusted(plant)(start, x, sizes[0], sizes[-1])
    return ca.Function("fpirhc_consistent_state", [start, y, p], [trusted], ["x", "y", "p"], ["found"])


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
    state = ca.if_else(last <= _POOR * first, reached, start)
    return ca.Function("fpirhc_trusted_state", [start, end, first, last], [state])


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
