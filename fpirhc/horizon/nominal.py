"""The model on the reference: its state where the reference gives it, else a simulation with the feedforward.

A state that is an output, or a derivative of one, has a reference. Inner states have none. Along a horizon they are simulated from
the start, x_{i+1} = F(x_i, u_i), with the input that the model needs for the nominal response, u_i = inverse(x_i, y^(r),N_i).
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.plant.instant import nominal_responses
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.expression import Matrix
from fpirhc.task.reference import Reference


def known_on_reference(plant: Plant) -> bool:
    """Whether the reference gives the whole state."""
    return min(plant.known_by_outputs) >= 0


def reference_state(plant: Plant, outputs: Matrix) -> Matrix:
    """Return the state on the reference.

    Args:
        plant: the model.
        outputs: the nominal outputs and their derivatives; of a plant without outputs its nominal state.

    Raises:
        NotSupported: the plant has states that no output shows.
    """
    if not plant.outputs:
        return outputs
    hidden = [e for e, place in zip(plant.state.elements, plant.known_by_outputs, strict=True) if place < 0]
    if hidden:
        raise NotSupported(
            f"the input along the reference needs the states {', '.join(hidden)}, which no output gives and which so have no "
            "reference; weigh the rate of the input, Quadratic(rate=...), in place of its deviation from a feedforward"
        )
    return outputs[list(plant.known_by_outputs)]


def feedforward(plant: Plant, outputs: Matrix, responses: Matrix, p: Matrix) -> Matrix:
    """Return the input that the model needs along the reference, where every state follows from the outputs.

    Args:
        plant: the model.
        outputs: see `reference_state`.
        responses: nominal highest derivatives of the face.
        p: parameters.

    Raises:
        NotSupported: see `reference_state`.
    """
    follows = None if known_on_reference(plant) else followed_state(plant)
    state = reference_state(plant, outputs) if follows is None else follows(outputs, p)
    return plant.inverse_function(state, nominal_responses(plant, outputs, responses), p)


def output_feedback(plant: Plant, x: Matrix, outputs: Matrix, p: Matrix, rate: float) -> Matrix:
    """Return sum_{k<r} C(r, k) rate^(r-k) e^(k) of every controlled output, with which its error decays; 0 for order 0.

    Args:
        plant: the plant.
        x: its state.
        outputs: nominal outputs and derivatives.
        p: its parameters.
        rate: per unit of time.
    """
    face, calm = plant.face, ca.DM.zeros(len(plant.names))
    error = outputs - plant.output_function(x, ca.DM.zeros(plant.input.size), p, calm)
    sums = []
    for name, order in plant.response_orders.items():
        places = [face.state.elements.index(name + "'" * k) for k in range(order)]
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
    """Return states (nx, m) and inputs (nu, m) of the approximate model on its outputs' reference, from the start.

    Args:
        plant: the model.
        reference: of its outputs.
        advance: Function (state, input, parameters) -> state at the next time.
        start: first state, shape (nx,).
        bounds: lower and upper bounds of the inputs, shape (nu,) each.
        times: shape (m,).
        rate: with which errors of the outputs decay, (d/dt + rate)^r e = 0; zero is the feedforward alone.
    """
    x, outputs, r = (ca.MX.sym(n, size) for n, size in _sizes(plant).items())
    known = [(k, place) for k, place in enumerate(plant.known_by_outputs) if place >= 0]
    entries = ca.vertsplit(x)
    for k, place in known:
        entries[k] = outputs[place]
    at, p = ca.vertcat(*entries), ca.MX(ca.DM(plant.approximate))
    wanted = nominal_responses(plant, outputs, r)
    needed = plant.inverse_function(at, wanted + output_feedback(plant, at, outputs, p, rate), p)
    command = ca.fmin(ca.fmax(needed, ca.DM(bounds[0])), ca.DM(bounds[1]))
    step = ca.Function("fpirhc_nominal", [x, outputs, r], [advance(at, command, p), at, command])
    outputs_at, responses_at = reference.function(plant).map(times.size)(times[None, :])
    _, states, inputs = step.mapaccum(times.size)(start, outputs_at, responses_at)
    return np.asarray(states.full()), np.asarray(inputs.full())


def _sizes(plant: Plant) -> dict[str, int]:
    return {"x": plant.state.size, "outputs": plant.output.size, "r": len(plant.face.names)}


def followed_state(plant: Plant) -> ca.Function | None:
    """Return the Function (y, y', ... below each relative order; parameters) -> state; None where some state does not follow."""
    x, u, p = plant.symbols()
    y = ca.SX.sym("y", plant.output.size)
    residuals = ca.vertsplit(plant.output_function(x, ca.SX.zeros(u.numel()), p, ca.SX.zeros(len(plant.names))) - y)
    known = {i: y[place] for i, place in enumerate(plant.known_by_outputs) if place >= 0}
    left = [i for i in range(x.numel()) if i not in known]
    rows = [_with(r, x, known) for k, r in enumerate(residuals) if k not in plant.known_by_outputs]
    while left:
        one = next(((r, i) for r in rows for i in left if _alone(r, x, i, left)), None)
        if one is None:
            break
        row, i = one
        known[i] = _root(row, x[i])
        left.remove(i)
        rows = [_with(r, x, {i: known[i]}) for r in rows if r is not row]
    if left and not _linear_system(rows, x, left):
        return None
    if left:
        hidden = ca.vertcat(*(x[i] for i in left))
        known |= dict(zip(left, ca.vertsplit(_root(ca.vertcat(*rows), hidden)), strict=True))
    return ca.Function("fpirhc_followed_state", [y, p], [ca.densify(ca.vertcat(*(known[i] for i in range(x.numel()))))])


def _with(expression: ca.SX, x: ca.SX, known: dict[int, ca.SX]) -> ca.SX:
    return (
        ca.substitute(expression, ca.vertcat(*(x[i] for i in known)), ca.vertcat(*known.values()))
        if known
        else expression
    )


def _alone(row: ca.SX, x: ca.SX, i: int, left: list[int]) -> bool:
    """Whether this entry is the only one that is left in the row, and the row is affine in it."""
    others = [x[j] for j in left if j != i]
    return (
        ca.depends_on(row, x[i])
        and ca.is_linear(row, x[i])
        and not (others and ca.depends_on(row, ca.vertcat(*others)))
    )


def _linear_system(rows: list[ca.SX], x: ca.SX, left: list[int]) -> bool:
    hidden = ca.vertcat(*(x[i] for i in left))
    if len(rows) != len(left) or not ca.is_linear(ca.vertcat(*rows), hidden):
        return False
    return bool(ca.sprank(ca.jacobian(ca.vertcat(*rows), hidden)) == len(left))


def _root(rows: ca.SX, unknown: ca.SX) -> ca.SX:
    """The zero of rows that are affine in the unknown."""
    at_zero = ca.substitute(rows, unknown, ca.SX.zeros(unknown.numel()))
    return -ca.solve(ca.densify(ca.jacobian(rows, unknown)), at_zero)
