"""The operator D of a plant, the next derivative of a quantity, and what follows from it: chains y, y', y'', ..., orders, slopes.

    D y = dy/dx f(x, u, p, w),        of a map  D y = (y(f(x, u, p, w)) - y(x)) / T

with u and the forcing w held over a cycle. Quantities are coordinates, each of which is a state, and outputs y = h(x, u, p).
The response of an output of order 0 is the output, and its nominal response the reference at the end of the cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from fpirhc.errors import Mistakes, refuse
from fpirhc.fields.kinds import takes
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.plant.motion import arguments_of, believed_in, by_name, controlled_places, sampling, unit_of
from fpirhc.plant.parameter import Parameter
from fpirhc.symbolic.expression import Matrix
from fpirhc.symbolic.layout import Expression

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant

Symbols = tuple[ca.SX, ca.SX, ca.SX, ca.SX]  # x, u, p, and the forcing w


def output_expression(plant: Plant, name: str, x: Expression, u: Expression, p: Expression) -> Expression:
    """Return a coordinate, or h(x, u, p) of an output."""
    if name in plant.coordinates:
        return x[plant.state.elements.index(name)]
    return stated_expression(plant, name, x, u, p) + believed_in(plant, name, p)


def stated_expression(plant: Plant, name: str, x: Expression, u: Expression, p: Expression) -> Expression:
    """Return what the user's function of an output gives."""
    what, expression = f"outputs: '{name}'", plant.outputs[name].expression
    arguments = by_name(plant, x, p)
    arguments = arguments if takes(expression, len(arguments)) else arguments_of(plant, x, u, p)
    return scalar_expression(what, called(what, expression, *arguments), of=expression, symbols=(x, u, p))


def operator(plant: Plant, symbols: Symbols) -> Callable[[Expression], Expression]:
    """Return D of expressions of these symbols."""
    x, u, p, w = symbols
    if plant.step is None:
        return lambda y: ca.jtimes(y, x, plant.equations.forced_rate(x, u, p, w))
    after, cycle = plant.equations.next(x, u, p, w), sampling(plant)
    return lambda y: (ca.substitute(ca.SX(y), x, after) - y) / cycle


def derivatives(plant: Plant, counts: Mapping[str, int], symbols: Symbols) -> dict[str, list[Expression]]:
    """Return y, D y, ... of quantities: each and so many derivatives."""
    found = {name: [output_expression(plant, name, *symbols[:3])] for name in counts}
    if any(counts.values()):
        along = operator(plant, symbols)
        for name, count in counts.items():
            for _ in range(count):
                found[name].append(along(found[name][-1]))
    return found


def output_order(plant: Plant, name: str) -> int | None:
    """Return the relative order of a quantity: the first derivative that depends on an input, or 0; None where none does."""
    x, u, p = plant.symbols()
    value = output_expression(plant, name, x, u, p)
    if ca.jacobian_sparsity(value, u).nnz():
        return 0
    if not _reached(plant, value, (x, u, p)):
        return None
    along = operator(plant, (x, u, p, ca.SX.zeros(len(plant.names))))
    for order in range(1, plant.state.size + 1):
        value = along(value)
        if ca.jacobian_sparsity(value, u).nnz():
            return order
    return None


def _reached(plant: Plant, value: Expression, symbols: tuple[ca.SX, ca.SX, ca.SX]) -> bool:
    """Whether an input reaches a state on which a quantity depends: derivatives of what none reaches may grow without end."""
    x, u, p = symbols
    rate = plant.equations.rate(x, u, p)
    patterns = ((rate, x), (rate, u), (value, x))
    on_state, on_input, seen = (ca.DM(ca.jacobian_sparsity(*pair), 1).full() > 0 for pair in patterns)
    for _ in range(x.numel()):
        seen = seen | (seen @ on_state)
    return bool((seen @ on_input).any())


def disturbed(plant: Plant, names: Sequence[str]) -> Plant:
    """Return the plant with disturbances of coordinates' responses, of outputs and of their responses as parameters of value 0."""
    mistakes = Mistakes("drift: disturbances of the model")
    responses = dict(zip(response_names(plant), plant.controlled_names, strict=True)) if plant.outputs else {}
    what = "coordinate, output or response of an output" if plant.outputs else "coordinate"
    mistakes.unknown(what, names, list(dict.fromkeys([*plant.names, *plant.chains, *responses])))
    if not names:
        mistakes.add("name at least one coordinate whose response is disturbed")
    for name in (disturbance_name(c) for c in names):
        if name in plant.parameters:
            mistakes.add(f"the plant has a parameter '{name}' already; rename it")
    mistakes.raise_if_any()
    orders = dict(zip(plant.names, plant.orders, strict=True))
    added = {disturbance_name(n): Parameter(0.0, 0.0, unit_of(plant, n + "'" * orders.get(n, 0))) for n in names}
    believed = {**plant.believed, **{n: disturbance_name(n) for n in names}}
    made = replace(plant, parameters={**plant.parameters, **added}, believed=believed)
    return replace(made, inverse=None) if plant.inverse is not None and _mixed(made) else made


def _mixed(plant: Plant) -> bool:
    """Whether a coordinate's disturbance is in the response of another quantity, so that a user's inverse does not know it."""
    x, u, p = plant.symbols()
    of = {parameter: name for name, parameter in plant.believed.items() if name in plant.coordinates}
    pattern = ca.jacobian_sparsity(plant.equations.controlled_response(x, u, p), p)
    parameters, controlled = plant.parameter.elements, plant.controlled_names
    pairs = zip(*pattern.get_triplet(), strict=True)
    return any(of.get(parameters[k], controlled[i]) != controlled[i] for i, k in pairs)


def disturbance_name(name: str) -> str:
    """Name of the parameter that disturbs a coordinate's response, an output (w_y), or an output's response (w_y_2 of y'')."""
    order = name.count("'")
    return f"w_{name.rstrip(chr(39))}_{order}" if order else f"w_{name}"


def without_disturbances(plant: Plant) -> Plant:
    """Return the plant without believed disturbances of its outputs' responses; itself where there are none."""
    kept = {name: parameter for name, parameter in plant.believed.items() if "'" not in name}
    return plant if kept == plant.believed else replace(plant, believed=kept)


@lru_cache(maxsize=8)  # the parts of a loop that is composed ask for the same few
def derivatives_function(plant: Plant, wanted: tuple[tuple[str, int], ...]) -> ca.Function:
    """Return the Function (state, input, parameters, forcing) -> the wanted derivatives, in their order."""
    symbols = *plant.symbols(), ca.SX.sym("w", len(plant.names))
    chains = derivatives(plant, dict(sorted(wanted)), symbols)  # of every name the highest
    column = ca.vertcat(*(chains[name][k] for name, k in wanted))
    return ca.Function("fpirhc_derivatives", list(symbols), [ca.densify(column)])


def response_names(plant: Plant) -> tuple[str, ...]:
    """Names of the highest derivatives of the controlled coordinates: "q1''"; of order 0 it is the output's own name."""
    return tuple(name + "'" * order for name, order in plant.response_orders.items())


def quantities(plant: Plant) -> dict[str, str]:
    """Return the unit of all that a sensor may show: states, outputs and their derivatives, and controlled responses."""
    return {
        name: unit_of(plant, name) for name in (*plant.state.elements, *plant.output.elements, *response_names(plant))
    }


def nominal_responses(
    plant: Plant, outputs: Matrix, responses: Matrix, later: Callable[[], Matrix] | None = None
) -> Matrix:
    """Return the nominal responses of the controlled quantities: highest derivatives, or the outputs of order 0 themselves."""
    instant = plant.at_once
    if not instant:
        return responses[controlled_places(plant)]
    ahead = outputs if later is None else later()
    places = [plant.output.elements.index(name) if name in instant else -1 for name in plant.controlled_names]
    entries = (responses[k] if at < 0 else ahead[at] for k, at in zip(controlled_places(plant), places, strict=True))
    return ca.vertcat(*entries)


def differentiated_signals(plant: Plant) -> tuple[str, ...]:
    """Return the signals on which an output of the plant, or a derivative below its relative order, depends."""
    x, u, p = plant.symbols()
    motion = plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names)))
    differentiated = [motion[k] for k, e in enumerate(plant.output.elements) if plant.equations.output_orders.get(e, 1)]
    places = {name: plant.parameter.elements.index(name) for name in plant.outside}
    return tuple(name for name, place in places.items() if ca.depends_on(ca.vertcat(*differentiated), p[place]))


def require_derivatives(plant: Plant, who: str, *, of_time: bool, instead: str) -> None:
    """Raise for an output of order 0, and where derivatives are `of_time` for a map: they have none."""
    reasons = [f"the command moves '{name}' at once (order 0)" for name in plant.at_once]
    if of_time and plant.step is not None:
        reasons.append("discrete time has only differences")
    refuse(f"{who} needs derivatives below the response, and {why}; {instead}" for why in reasons)


def zero_dynamics(plant: Plant, state: np.ndarray, command: np.ndarray) -> float:
    """Return the largest real part of the rates at which states of the plant move at a point while its outputs are held."""
    a, b, c, d, y = (np.asarray(m.full()) for m in _slopes(plant)(state, command, plant.exact))
    free = np.linalg.svd(y)[2][np.linalg.matrix_rank(y) :].T if len(y) else np.eye(len(a))
    return float(np.linalg.eigvals(free.T @ (a - b @ np.linalg.pinv(d) @ c) @ free).real.max())


@lru_cache(maxsize=8)  # it is asked at several points
def _slopes(plant: Plant) -> ca.Function:
    x, u, p = plant.symbols()
    rates, responses = plant.equations.rate(x, u, p), plant.equations.controlled_response(x, u, p)
    shown, orders = plant.equations.output(x, u, p, ca.SX.zeros(len(plant.names))), plant.response_orders
    below = [k for k, e in enumerate(plant.output.elements) if orders.get(e.rstrip("'"), 0)]  # none of order 0
    chain = ca.vertcat(ca.SX(0, 1), *(shown[k] for k in below))
    pairs = ((rates, x), (rates, u), (responses, x), (responses, u), (chain, x))
    return ca.Function("fpirhc_state_slopes", [x, u, p], [ca.densify(ca.jacobian(one, by)) for one, by in pairs])
