"""The state that follows from the outputs and their derivatives, where each entry can be solved for: y, y', ... = h(x, p).

An entry that is an output, or a derivative of one, is that number. Another one follows where it stands alone and affinely in an
output's derivative whose other states are known already, one after the other; what is left is a linear system where it is affine.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.plant.plant import Plant


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
