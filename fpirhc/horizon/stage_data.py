"""The data of the stages of one horizon: time, reference, feedforward, parameters, and what else its stages read.

Where cost or limits have open numbers, the data of every stage end with these settings.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.cost import Cost, Horizon, reads_feedforward
from fpirhc.horizon.nominal import feedforward
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import kind
from fpirhc.symbolic.layout import Layout, Signal, scalar
from fpirhc.task.reference import Reference


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
    settings: int = 0,
    signals: ca.Function | None = None,
    *,
    previewed: bool = False,
) -> ca.Function:
    """Function (time, parameters) -> data of all stages, shape (ntheta, N + 1), along the nominal motion.

    With `settings` rows of open numbers, (time, parameters, these rows) -> data that end with them. With
    `signals`, a Function (time, parameters) -> parameters, every stage has those of its middle. Where the reference is
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
    given = [ca.MX.sym("settings", settings)] if settings else []
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
        *(ca.repmat(v, 1, count) for v in given),
    )
    names = ["t", *columns, "p", *(["settings"] if settings else [])]
    return ca.Function("fpirhc_horizon_data", [start, *tables, parameters, *given], [table], names, ["data"])


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


def setting_rows(paths: tuple[str, ...]) -> Layout:
    """Return the signals at the end of a stage's data; none without settings."""
    if not paths:
        return Layout()
    return Layout((Signal("settings", paths),))
