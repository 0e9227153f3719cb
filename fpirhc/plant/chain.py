"""Derivatives of a plant's coordinates and outputs as functions of its state: the Lie derivatives y, y', y'', ... along its motion.

With u and the forcing w held over a cycle, y_0 = the quantity and y_{k+1} = dy_k/dx x'(x, u, p, w); one that is a state or a
response is that entry itself. The response of an output of order 0 is the output, and its nominal response the reference at the end
of the cycle: there it is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.plant.lie_derivatives import Symbols, lie_derivatives, output_expression, output_order, structural_order
from fpirhc.plant.motion import controlled_places, derivative_unit, followed_units, outside_names
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import Matrix
from fpirhc.symbolic.layout import Expression, Signal

_FUNCTIONS: Latest[ca.Function] = Latest(8)  # the parts of a loop that is composed ask for the same few


def derivatives_function(plant: Plant, wanted: Sequence[tuple[str, int]]) -> ca.Function:
    """Return the Function (state, input, parameters, forcing) -> the wanted derivatives, in their order.

    `wanted`: (coordinate or output, number of the derivative) of every entry.
    """
    return _FUNCTIONS.of((plant,), tuple(wanted), lambda: _derivatives(plant, wanted))


def _derivatives(plant: Plant, wanted: Sequence[tuple[str, int]]) -> ca.Function:
    x, u, p = plant.symbols()
    w = ca.SX.sym("w", len(plant.names))
    most = dict[str, int]()
    for name, k in wanted:
        most[name] = max(k, most.get(name, k))
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
    return w if plant.step is not None else plant.equations.response(x, u, p) + w


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
        rate = plant.equations.forced_rate(x, u, p, w)
        for _ in range(count - order):
            chain.append(ca.jtimes(chain[-1], x, rate))
    return chain


def measured_signals(plant: Plant) -> tuple[Signal, ...]:
    """Return the signals of what a controller is given of the motion: the state, and the outputs where there are any."""
    return tuple(dict.fromkeys((plant.state, plant.output)))


def response_names(plant: Plant) -> tuple[str, ...]:
    """Names of the highest derivatives of the controlled coordinates: "q1''"; of order 0 it is the output's own name."""
    return tuple(name + "'" * order for name, order in plant.response_orders.items())


def response_units(plant: Plant) -> tuple[str, ...]:
    """Return the units of the derivatives that end the chains of all outputs, or coordinates."""
    units, time = followed_units(plant), plant.time_unit
    return tuple(derivative_unit(units[name], order, time) for name, order in plant.chains.items())


def nominal_responses(
    plant: Plant, outputs: Matrix, responses: Matrix, later: Callable[[], Matrix] | None = None
) -> Matrix:
    """Return the nominal responses of the controlled quantities: highest derivatives, or the outputs of order 0 themselves.

    Args:
        outputs: nominal outputs and their derivatives, in the order of `Plant.output`; without outputs the state.
        later: gives the outputs at the end of the cycle, where one is of order 0; None: `outputs`.
    """
    instant = [name for name, order in plant.response_orders.items() if not order]
    if not instant:
        return responses[controlled_places(plant)]
    ahead = outputs if later is None else later()
    places = [plant.output.elements.index(name) if name in instant else -1 for name in plant.controlled_names]
    entries = (responses[k] if at < 0 else ahead[at] for k, at in zip(controlled_places(plant), places, strict=True))
    return ca.vertcat(*entries)


def differentiated_signals(plant: Plant) -> tuple[str, ...]:
    """Return the signals on which an output of the plant, or a derivative below its relative order, depends."""
    if not plant.outputs:
        return ()
    x, u, p = plant.symbols()
    motion = plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names)))
    differentiated = [motion[k] for k, e in enumerate(plant.output.elements) if plant.equations.output_orders.get(e, 1)]
    places = {name: plant.parameter.elements.index(name) for name in outside_names(plant)}
    return tuple(name for name, place in places.items() if ca.depends_on(ca.vertcat(*differentiated), p[place]))


def relative_order(plant: Plant, name: str) -> int | None:
    """Return the relative order of a coordinate or an output from the symbols; None where no input reaches it."""
    return structural_order(plant, name) if name in plant.coordinates else output_order(plant, name)


def rateless(plant: Plant) -> str:
    """Return why a response is no derivative with respect to time; empty where every one is."""
    if plant.step is not None:
        return "a map has differences of its steps"
    return next((f"{name} is of order 0" for name, order in plant.response_orders.items() if not order), "")


def require_rates(plant: Plant, refusal: str) -> None:
    """Raise where the states have no derivatives with respect to time."""
    if plant.step is not None:
        raise NotSupported(refusal)


class StateSlopes(NamedTuple):
    """A (nx, nx), B (nx, nu), C (n, nx), D (n, nu), Y (sum of relative orders, nx), of the controlled coordinates or outputs."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    y: np.ndarray


def state_slopes(plant: Plant, state: np.ndarray, command: np.ndarray, parameters: np.ndarray) -> StateSlopes:
    """Return the slopes at a point; those of a map are of its divided differences."""
    return StateSlopes(*(np.asarray(m.full()) for m in _slopes(plant)(state, command, parameters)))


@lru_cache(maxsize=8)  # several questions of a review need it
def _slopes(plant: Plant) -> ca.Function:
    x, u, p = plant.symbols()
    rates, responses = plant.equations.rate(x, u, p), plant.equations.controlled_response(x, u, p)
    shown, orders = plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names))), plant.response_orders
    below = [k for k, e in enumerate(plant.output.elements) if orders.get(e.rstrip("'"), 0)]  # none of order 0
    chain = ca.vertcat(ca.SX(0, 1), *(shown[k] for k in below))
    pairs = ((rates, x), (rates, u), (responses, x), (responses, u), (chain, x))
    return ca.Function("fpirhc_state_slopes", [x, u, p], [ca.densify(ca.jacobian(one, by)) for one, by in pairs])


def zero_dynamics(s: StateSlopes) -> float:
    """Return the largest real part of the rates at which states move while the outputs are held."""
    free = np.linalg.svd(s.y)[2][np.linalg.matrix_rank(s.y) :].T if len(s.y) else np.eye(len(s.a))
    return float(np.linalg.eigvals(free.T @ (s.a - s.b @ np.linalg.pinv(s.d) @ s.c) @ free).real.max())
