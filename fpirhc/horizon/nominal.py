"""The model on the reference: its state where the reference gives it, else a simulation with the feedforward; data of the stages.

A state that is an output, or a derivative of one, has a reference. Inner states have none. Along a horizon they are simulated from
the start, x_{i+1} = F(x_i, u_i), with the input that the model needs for the nominal response, u_i = inverse(x_i, y^(r),N_i).

The data of a stage are time, reference, feedforward, parameters, what else it reads, and open numbers of cost and limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import require
from fpirhc.horizon.cost import Cost, Horizon, reads_feedforward
from fpirhc.plant.chain import nominal_responses
from fpirhc.plant.integrators import Integrator
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Matrix, kind
from fpirhc.symbolic.layout import Layout, Signal, scalar
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
) -> np.ndarray:
    """Return states (nx, m) of the model that follows the reference of its outputs for 20 000 cycles."""
    period, cycles = times[0], min(times[1], _CYCLES)
    x, u, p = plant.symbols()
    advance, w = integrator.step(plant, period), np.zeros(len(plant.names))
    xm, um, pm = (ca.MX.sym(n, v.numel()) for n, v in (("x", x), ("u", u), ("p", p)))
    step = ca.Function("fpirhc_advance", [xm, um, pm], [advance(xm, um, pm, w)])
    rate = min(_DECAYS / (period * times[1]), _FASTEST / period)
    ends = np.array(bounds[0]), np.array(bounds[1])
    return nominal_motion(plant, reference, step, np.array(start), ends, period * np.arange(cycles), rate)[0]


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


def data_layout(plant: Plant, horizon: Horizon) -> Layout:
    """Layout of one stage's data; haste: first stages per time since the last change of inputs, offset: of the measured state."""
    free = (scalar("free"),) if horizon.blocks else ()
    units = dict(zip(plant.state.elements, plant.state.units, strict=True))
    shown = horizon.measured
    offset = (Signal("offset", shown, tuple(units[e] for e in shown)),) if shown else ()
    haste = (scalar("haste"),) if hastened(horizon) else ()
    length = (scalar("length"),) if horizon.lengths else ()
    return Layout(
        (
            plant.time,
            Signal("reference", plant.output.elements, plant.output.units),
            Signal("feedforward", plant.input.elements, plant.input.units),
            plant.parameter,
            *free,
            *offset,
            *haste,
            *length,
        )
    )


def hastened(horizon: Horizon) -> bool:
    """Return whether the change of inputs takes another time in some stages than in others."""
    return horizon.share < 1 or bool(horizon.lengths)


def stage_data(
    plant: Plant,
    reference: Reference,
    horizon: Horizon,
    cost: Cost,
    signals: ca.Function | None = None,
    *,
    previewed: bool = False,
) -> ca.Function:
    """Function (time, parameters) -> data of all stages, shape (ntheta, N + 1), along the nominal motion.

    With `signals`, a Function (time, parameters) -> parameters, every stage has those of its middle. Where the reference is
    `previewed`, its states (nx, N + 1) and responses (n, N + 1) follow the time as arguments.
    """
    looked_up = signals is not None and not signals.is_a("SXFunction")
    matrix = kind(plant.equations.inverse_opaque or looked_up)
    t, half, of_cycle = matrix.sym("t"), matrix.sym("half"), matrix.sym("p", plant.parameter.size)
    p = of_cycle if signals is None else signals(t + half, of_cycle)
    motion = [matrix.sym("x", plant.output.size), matrix.sym("r", len(plant.chains))] if previewed else []
    state, response = motion or reference.function(plant)(t)
    zero = matrix.zeros(plant.input.size)
    needed = feedforward(plant, state, response, p) if reads_feedforward(plant, cost) else zero
    one = ca.Function("fpirhc_stage_data", [t, half, of_cycle, *motion], [ca.densify(ca.vertcat(t, state, needed, p))])
    start, parameters, count = ca.MX.sym("t"), ca.MX.sym("p", plant.parameter.size), horizon.stages + 1
    columns = dict(zip(("states", "responses"), motion, strict=False))
    tables = [ca.MX.sym(name, m.numel(), count) for name, m in columns.items()]
    lasting = np.append(np.diff(horizon.nodes), horizon.last) if horizon.lengths else np.full(count, horizon.step)
    times, halves = start + ca.DM(horizon.nodes).T, ca.DM(0.5 * lasting).T
    rows: list[np.ndarray] = []
    rows += [np.isin(np.arange(count), [0, *np.cumsum(horizon.blocks)])[None, :]] if horizon.blocks else []
    rows += [np.zeros((len(horizon.measured), count))] if horizon.measured else []
    rows += [1 / np.array([[horizon.share, *horizon.relative_lengths]])] if hastened(horizon) else []
    rows += [np.array([[*horizon.lengths, horizon.lengths[-1]]])] if horizon.lengths else []
    table = ca.vertcat(
        one.map(count)(times, halves, ca.repmat(parameters, 1, count), *tables),
        *(ca.DM(row.astype(float)) for row in rows),
    )
    return ca.Function("fpirhc_horizon_data", [start, *tables, parameters], [table], ["t", *columns, "p"], ["data"])


def shifted_reference(plant: Plant, layout: Layout, nodes: int, *, corrected: bool) -> ca.Function:
    """Function (data, state, measured outputs, parameters, command that acts) -> data whose reference is less their distance.

    The distance d = y - h(x, u, p) of the measured outputs from the model's, at the state from which the plan starts, is held over
    the horizon. That of the derivatives is not extrapolated: a polynomial is the motion of a chain of integrators, and no other
    model stays on it. Behind a deformation the plan starts where there is no distance (see `consistent_state`).

    Args:
        plant: the model, with outputs.
        layout: of one stage's data.
        nodes: number of columns of the data.
        corrected: whether a law or a deformation behind the plan takes back the distance of outputs of order 0.
    """
    x, u, p = plant.symbols()
    y, column = ca.SX.sym("y", plant.output.size), ca.SX.sym("data", layout.size)
    error = y - plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names)))
    place, difference = layout.slice("reference"), ca.SX.zeros(layout.size)
    for k, element in enumerate(plant.output.elements):
        order = plant.equations.output_orders.get(element)  # None: of a derivative
        if order or (order == 0 and not corrected):
            difference[place.start + k] = error[k]
    one = ca.Function("fpirhc_shifted_column", [column, x, y, p, u], [ca.densify(column - difference)])
    sizes = {"x": x.numel(), "y": y.numel(), "p": p.numel(), "u": u.numel()}
    data, arguments = ca.MX.sym("data", layout.size, nodes), [ca.MX.sym(name, size) for name, size in sizes.items()]
    repeated = [ca.repmat(v, 1, nodes) for v in arguments]
    return ca.Function("fpirhc_shifted_reference", [data, *arguments], [one.map(nodes)(data, *repeated)])


def offset_limits(plant: Plant, horizon: Horizon, layout: Layout) -> ca.Function:
    """Function (data, state from which the plan starts, measured state) -> data with the distance of the measured state."""
    nodes, rows = horizon.stages + 1, layout.slice("offset")
    places = [plant.state.elements.index(name) for name in horizon.measured]
    data = ca.MX.sym("data", layout.size, nodes)
    start, state = (ca.MX.sym(name, plant.state.size) for name in ("start", "state"))
    offset = ca.repmat(state[places] - start[places], 1, nodes)
    table = ca.vertcat(data[: rows.start, :], offset, data[rows.stop :, :])
    return ca.Function("fpirhc_offset_limits", [data, start, state], [table])
