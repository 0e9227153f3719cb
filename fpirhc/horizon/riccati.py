"""Riccati sweeps that solve the horizon's quadratic model stage by stage: within the input bounds, and with weights and gaps.

Sources: D. Q. Mayne, Int. J. Control 3(1), 1966; Y. Tassa, N. Mansard, E. Todorov, IEEE ICRA 2014, for the box of the inputs;
H. G. Bock, K. J. Plitt, IFAC World Congress 1984, for the gaps.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from fpirhc.horizon.hessian_models import HessianModel, hessian_end, hessian_stage, linear_stage, stage_symbols
from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.expression import TINY, is_finite, kind

_SCALAR_CODE = 1000  # multiplications of one stage up to which scalar code is faster than matrix calls
BOX_PIVOT = 1e-12  # relative size below which a pivot is replaced: the direction then still descends
PIVOT = 1e-13  # relative size of a pivot below which a matrix does not count as positive definite


def rounds(inputs: int) -> int:
    """Largest number of active-set changes of a stage's box QP."""
    return 2 * inputs if inputs > 1 else 1


def backward_sweep(ocp: OptimalControl, damping: float) -> ca.Function:
    """Function (stage columns, P_N, p_N) -> (v (nu, N), K (nu, ns N), Q_uu (nu, nu N), fall).

    v is in [lower - u, upper - u], and fall is what the sweep promises to lower the cost by.

    With the cost to go of stage i+1 modelled by 1/2 dx'P dx + p'dx, stage i minimises Q_u' v + 1/2 v' Q_uu v with

        Q_u = l_u + B'p,   Q_uu = R + B'P B + mu D^-1,   Q_us = S + B'P A.

    Inputs that end at a bound get no feedback; the others get K = -Q_uu^-1 Q_us on the free set. Then P <- Q + A'PA + Q_us'K and
    p <- Q_s + Q_us'v + K'(Q_u + Q_uu v). Without active bounds v, rolled out through the linear model with K, is -M^-1 g with M the
    Hessian of the quadratic model: a preconditioner that couples all stages, at the cost of N small factorisations.

    The stage columns, each stacked over the stages, are A, B, l_s, l_u, Q, S, R, U, lower, upper.
    """
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    shapes = {"A": ns, "B": nu, "ls": 1, "lu": 1, "Q": ns, "S": ns, "R": nu, "U": 1, "lower": 1, "upper": 1}
    rows = {"A": ns, "B": ns, "ls": ns, "lu": nu, "Q": ns, "S": nu, "R": nu, "U": nu, "lower": nu, "upper": nu}
    stacked = [ca.MX.sym(name, rows[name], columns * n) for name, columns in shapes.items()]
    value, slope = ca.MX.sym("P", ns, ns), ca.MX.sym("p", ns)
    sweep = _stage(ocp, damping).mapaccum("fpirhc_riccati_stages", n, 2)
    reversed_stages = [in_reverse(column, n) for column in stacked]
    _, _, moves, gains, curved, falls = sweep(value, slope, *reversed_stages)
    results = [in_reverse(moves, n), in_reverse(gains, n), in_reverse(curved, n), ca.sum2(falls)]
    names = [*shapes, "P", "p"]
    return ca.Function("fpirhc_riccati", [*stacked, value, slope], results, names, ["v", "K", "Q_uu", "fall"])


def _stage(ocp: OptimalControl, damping: float) -> ca.Function:
    """Function (P, p, A, B, l_s, l_u, Q, S, R, u, lower, upper) -> (P, p, v, K, Q_uu, fall)."""
    ns, nu = ocp.state.size, ocp.input.size
    sym = kind(opaque=ns * ns * (ns + nu) > _SCALAR_CODE).sym
    value, slope = sym("P", ns, ns), sym("p", ns)
    a, b, by_state, by_input = sym("A", ns, ns), sym("B", ns, nu), sym("ls", ns), sym("lu", nu)
    q, s, r = sym("Q", ns, ns), sym("S", nu, ns), sym("R", nu, nu)
    u, lower, upper = sym("u", nu), sym("lower", nu), sym("upper", nu)
    added = ca.DM(np.diag(damping / ocp.scale))
    value_a = ca.mtimes(value, a)
    damped = r + ca.mtimes(b.T, ca.mtimes(value, b)) + added
    coupled = s + ca.mtimes(b.T, value_a)
    input_slope = by_input + ca.mtimes(b.T, slope)
    move, gain = box_policy(nu, ns)(input_slope, damped, coupled, lower - u, upper - u)
    next_value = q + ca.mtimes(a.T, value_a) + ca.mtimes(coupled.T, gain)
    next_slope = by_state + ca.mtimes(a.T, slope) + ca.mtimes(coupled.T, move)
    next_slope += ca.mtimes(gain.T, input_slope + ca.mtimes(damped, move))
    fall = -0.5 * ca.dot(input_slope, move)
    arguments = [value, slope, a, b, by_state, by_input, q, s, r, u, lower, upper]
    results = [0.5 * (next_value + next_value.T), next_slope, move, gain, damped, fall]
    return ca.Function("fpirhc_riccati_stage", arguments, results)


def box_policy(nu: int, ns: int) -> ca.Function:
    """Function (Q_u, Q_uu, Q_us, low, high) -> (v, K): the stage's box QP by projected Newton steps, and its feedback.

    The best move of all rounds is the result, so it is at least as good as v = 0. It is v = 0 only where the first-order conditions
    with bounds hold.
    """
    slope, hessian, coupled = ca.SX.sym("Qu", nu), ca.SX.sym("Quu", nu, nu), ca.SX.sym("Qus", nu, ns)
    low, high = ca.SX.sym("low", nu), ca.SX.sym("high", nu)
    move, best, lowest = ca.SX.zeros(nu), ca.SX.zeros(nu), ca.SX(0)
    for _ in range(rounds(nu)):
        free = _free(move, slope + hessian @ move, low, high)
        target = -(slope + hessian @ ((1 - free) * move))
        wanted = solve_free(hessian, free, target)
        move = ca.fmin(ca.fmax(free * wanted + (1 - free) * move, low), high)
        value = ca.dot(slope + 0.5 * (hessian @ move), move)
        better = value < lowest
        best, lowest = ca.if_else(better, move, best), ca.if_else(better, value, lowest)
    free = _free(best, slope + hessian @ best, low, high)
    gain = solve_free(hessian, free, -coupled)
    return ca.Function("fpirhc_box_policy", [slope, hessian, coupled, low, high], ca.cse([best, gain]))


def _free(move: ca.SX, slope: ca.SX, low: ca.SX, high: ca.SX) -> ca.SX:
    """1 where a change of the input can lower the cost, 0 where its bound prevents that."""
    at_bound = ca.logic_or(ca.logic_and(move <= low, slope > 0), ca.logic_and(move >= high, slope < 0))
    return ca.if_else(at_bound, 0, 1)


def solve_free(hessian: ca.SX, free: ca.SX, right: ca.SX) -> ca.SX:
    """Solve the free rows and columns by L D L'; rows that are not free are zero.

    A pivot that is not positive is replaced by the size of its diagonal entry, so that the result is still a descent direction.
    """
    n = hessian.shape[0]
    lower, pivots = ca.SX.eye(n), list[ca.SX]()
    for j in range(n):
        known = sum((lower[j, k] ** 2 * pivots[k] for k in range(j)), start=ca.SX(0))
        pivot = free[j] * (hessian[j, j] - known) + (1 - free[j])
        size = ca.fabs(hessian[j, j]) + TINY
        pivots.append(ca.if_else(pivot > BOX_PIVOT * size, pivot, size))
        for i in range(j + 1, n):
            known = sum((lower[i, k] * lower[j, k] * pivots[k] for k in range(j)), start=ca.SX(0))
            lower[i, j] = free[i] * free[j] * (hessian[i, j] - known) / pivots[j]
    solution = ca.SX(right)
    for i in range(n):
        solution[i, :] = free[i] * right[i, :] - sum(
            (lower[i, k] * solution[k, :] for k in range(i)), start=ca.SX.zeros(1, right.shape[1])
        )
    for i in range(n):
        solution[i, :] = solution[i, :] / pivots[i]
    for i in reversed(range(n)):
        solution[i, :] = solution[i, :] - sum(
            (lower[k, i] * solution[k, :] for k in range(i + 1, n)), start=ca.SX.zeros(1, right.shape[1])
        )
    return solution


class Expansion(NamedTuple):
    """A plan and its derivatives, stage by stage side by side."""

    inputs: ca.MX  # (nu, N)
    states: ca.MX  # (ns, N + 1)
    next_states: ca.MX  # F (ns, N)
    a: ca.MX  # (ns, ns N)
    b: ca.MX  # (ns, nu N)
    by_state: ca.MX  # (ns, N)
    by_input: ca.MX  # (nu, N)
    tail: ca.MX  # T_s (ns)
    final: ca.MX  # T_ss (ns, ns)
    value: ca.MX


def expansion_shapes(ocp: OptimalControl) -> tuple[tuple[int, int], ...]:
    """Return the shapes of all parts, in the order of `Expansion`."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    return ((nu, n), (ns, n + 1), (ns, n), (ns, ns * n), (ns, nu * n), (ns, n), (nu, n), (ns, 1), (ns, ns), (1, 1))


def expand(ocp: OptimalControl) -> ca.Function:
    """Function (U, X, K (nu, ns N), rolled, gaps (ns, N), s0, data, lower, upper) -> the parts of `Expansion`.

    The plan is expanded at its own nodes after s_0; where `rolled`, at the states of a rollout with u = clip(U + K (x - X)) and
    x+ = F(x, u) - gap.
    """
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    node, _, theta = stage_symbols(ocp)
    at, u, gain, rolled = ca.SX.sym("at", ns), ca.SX.sym("u", nu), ca.SX.sym("K", nu, ns), ca.SX.sym("rolled")
    low, high, gap = ca.SX.sym("low", nu), ca.SX.sym("high", nu), ca.SX.sym("gap", ns)
    x = ca.if_else(rolled, at, node)
    used = ca.if_else(rolled, ca.fmin(ca.fmax(u + gain @ (at - node), low), high), u)
    next_state, cost, a, b, by_state, by_input = linear_stage(ocp)(x, used, theta)
    results = [next_state - gap, x, used, cost, next_state, a, b, by_state, by_input]
    stage = ca.Function("fpirhc_expand_stage", [at, node, u, gain, theta, gap, low, high, rolled], results)
    inputs, states, gains = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1), ca.MX.sym("K", nu, ns * n)
    flag, s0, data = ca.MX.sym("rolled"), ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
    lower, upper, gaps = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu), ca.MX.sym("gaps", ns, n)
    nodes = ca.horzcat(s0, states[:, 1:n]) if n > 1 else s0
    repeated = [ca.repmat(v, 1, n) for v in (lower, upper, flag)]
    made = stage.mapaccum("fpirhc_expand_stages", n)(s0, nodes, inputs, gains, data[:, :n], gaps, *repeated)
    after, before, used_inputs, costs, *rest = made
    last = ca.if_else(flag, after[:, n - 1], states[:, n])
    final, tail, end_hessian = hessian_end(ocp)(last, data[:, n])
    parts = [used_inputs, ca.horzcat(before, last), *rest, tail, end_hessian, ca.sum2(costs) + final]
    return ca.Function("fpirhc_expand", [inputs, states, gains, flag, gaps, s0, data, lower, upper], parts)


def sweep(
    ocp: OptimalControl, hessian: HessianModel, places: tuple[int, ...], scales: tuple[np.ndarray, np.ndarray]
) -> ca.Function:
    """Function (expansion, W, w, costates (ns, N), mu, data) -> (v, K, dx (ns, N + 1), du, costates, ok).

    A plan (X, U) need not be a trajectory: its gaps are c_i = F(X_i, U_i) - X_{i+1}. With diagonal weights W and gradients w,

        backward   P' = P + W,  p' = p + w + (P + W) c,   Q_uu = R + W_u + mu D^-1 + B'P'B,   K = -Q_uu^-1 (S + B'P'A),
                   v = -Q_uu^-1 (l_u + w_u + B'p'),       P <- Q + A'P'A + (S + B'P'A)'K,     p <- l_s + A'p' + (S + B'P'A)'v,
        forward    du = v + K dx,   dx+ = A dx + B du + c,   lambda = P' dx + p + w:

    Newton's step of all first-order conditions at once. `ok` shows whether every Q_uu is positive definite.

    Args:
        places: the limited states: rows of W and w after those of the inputs.
        scales: of the inputs (nu,) and of the states (ns,), multiplied by mu.
    """
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    p = Expansion(
        *(ca.MX.sym(name, *shape) for name, shape in zip(Expansion._fields, expansion_shapes(ocp), strict=True))
    )
    weight, lean = (ca.MX.sym(name, nu + len(places), n) for name in ("W", "w"))
    costates, mu, data = ca.MX.sym("lambda", ns, n), ca.MX.sym("mu"), ca.MX.sym("data", ocp.data.size, n + 1)
    selection = ca.DM(ns, len(places))
    for column, row in enumerate(places):
        selection[row, column] = 1
    by_limit = [ca.mtimes(selection, m[nu:, :]) for m in (weight, lean)]
    gaps = p.next_states - p.states[:, 1:]
    hessians = hessian_stage(ocp, hessian).map(n)(p.states[:, :n], p.inputs, data[:, :n], costates)
    columns = [p.a, p.b, p.by_state, p.by_input, gaps, *hessians, *by_limit, weight[:nu, :], lean[:nu, :]]
    turned = [in_reverse(c, n) for c in [*columns, ca.repmat(mu, 1, n)]]
    back = _backward(ocp, scales).mapaccum("fpirhc_sweep_back", n, 2)(p.final, p.tail, *turned)
    _, _, *steps = back
    v, k, values, slopes, ok = (in_reverse(c, n) for c in steps)
    ahead = _forward(ns, nu).mapaccum("fpirhc_sweep_ahead", n)(ca.MX.zeros(ns), p.a, p.b, gaps, v, k, values, slopes)
    after, du, after_costates = ahead
    dx = ca.horzcat(ca.MX.zeros(ns), after)
    numbers = ca.vertcat(ca.vec(du), ca.vec(dx), ca.vec(after_costates))
    fine = ca.logic_and(ca.mmin(ok) > 0, is_finite(numbers))
    arguments = [*p, weight, lean, costates, mu, data]
    return ca.Function("fpirhc_sweep", arguments, [v, k, dx, du, after_costates, fine])


def in_reverse(stacked: ca.MX, stages: int) -> ca.MX:
    """Return the blocks of the stages in reverse order."""
    return ca.horzcat(*reversed(ca.horzsplit(stacked, stacked.shape[1] // stages))) if stages > 1 else stacked


def _backward(ocp: OptimalControl, scales: tuple[np.ndarray, np.ndarray]) -> ca.Function:
    """Function (P, p, A, B, l_s, l_u, c, Q, S, R, W_x, w_x, W_u, w_u, mu) -> (P, p, v, K, P', p + w, ok)."""
    ns, nu = ocp.state.size, ocp.input.size
    matrix = kind(ns * ns * (ns + nu) > _SCALAR_CODE)
    shapes = {"P": (ns, ns), "p": (ns, 1), "A": (ns, ns), "B": (ns, nu), "ls": (ns, 1), "lu": (nu, 1), "c": (ns, 1)}
    shapes |= {"Q": (ns, ns), "S": (nu, ns), "R": (nu, nu), "Wx": (ns, 1), "wx": (ns, 1), "Wu": (nu, 1), "wu": (nu, 1)}
    y = {name: matrix.sym(name, *shape) for name, shape in (shapes | {"mu": (1, 1)}).items()}
    by_input, by_state = scales
    value, slope = y["P"] + ca.diag(y["Wx"] + y["mu"] * ca.DM(by_state)), y["p"] + y["wx"]
    pushed, ahead = slope + ca.mtimes(value, y["c"]), ca.mtimes(value, y["A"])
    q_uu = y["R"] + ca.mtimes(y["B"].T, ca.mtimes(value, y["B"])) + ca.diag(y["Wu"] + y["mu"] * ca.DM(by_input))
    cross, steep = y["S"] + ca.mtimes(y["B"].T, ahead), y["lu"] + y["wu"] + ca.mtimes(y["B"].T, pushed)
    solution, ok = _definite(nu, 1 + ns)(q_uu, ca.horzcat(-steep, -cross))
    v, k = solution[:, 0], solution[:, 1:]
    before = y["Q"] + ca.mtimes(y["A"].T, ahead) + ca.mtimes(cross.T, k)
    lean = y["ls"] + ca.mtimes(y["A"].T, pushed) + ca.mtimes(cross.T, v)
    return ca.Function(
        "fpirhc_sweep_back_stage", list(y.values()), [0.5 * (before + before.T), lean, v, k, value, slope, ok]
    )


def _forward(ns: int, nu: int) -> ca.Function:
    """Function (dx, A, B, c, v, K, P', p + w) -> (dx+, du, lambda of dx+)."""
    shapes = ((ns, 1), (ns, ns), (ns, nu), (ns, 1), (nu, 1), (nu, ns), (ns, ns), (ns, 1))
    dx, a, b, gap, v, k, value, slope = y = [ca.MX.sym(f"y{j}", *shape) for j, shape in enumerate(shapes)]
    du = v + ca.mtimes(k, dx)
    after = ca.mtimes(a, dx) + ca.mtimes(b, du) + gap
    return ca.Function("fpirhc_sweep_ahead_stage", y, [after, du, ca.mtimes(value, after) + slope])


def _definite(n: int, columns: int) -> ca.Function:
    """Function (M, right) -> (M^-1 right by L D L', 1 when every pivot is positive)."""
    matrix, right = ca.SX.sym("M", n, n), ca.SX.sym("r", n, columns)
    lower, pivots, ok, rows = ca.SX.eye(n), list[ca.SX](), ca.SX(1), list[ca.SX]()
    for j in range(n):
        pivot = matrix[j, j] - sum((lower[j, k] ** 2 * pivots[k] for k in range(j)), start=ca.SX(0))
        ok = ca.logic_and(ok, pivot > PIVOT * ca.fabs(matrix[j, j]))
        pivots.append(pivot)
        for i in range(j + 1, n):
            known = sum((lower[i, k] * lower[j, k] * pivots[k] for k in range(j)), start=ca.SX(0))
            lower[i, j] = (matrix[i, j] - known) / pivot
    for i in range(n):
        rows.append(right[i, :] - sum((lower[i, k] * rows[k] for k in range(i)), start=ca.SX.zeros(1, columns)))
    rows = [row / pivot for row, pivot in zip(rows, pivots, strict=True)]
    for i in reversed(range(n)):
        rows[i] = rows[i] - sum((lower[k, i] * rows[k] for k in range(i + 1, n)), start=ca.SX.zeros(1, columns))
    return ca.Function("fpirhc_definite", [matrix, right], ca.cse([ca.vertcat(*rows), ok]))
