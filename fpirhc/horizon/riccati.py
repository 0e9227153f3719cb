"""The Riccati sweep that solves the horizon's quadratic model stage by stage, within the input bounds.

Sources: D. Q. Mayne, Int. J. Control 3(1), 1966; Y. Tassa, N. Mansard, E. Todorov, IEEE ICRA 2014, for the box of the inputs.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.expression import TINY, kind

_SCALAR_CODE = 1000  # multiplications of one stage up to which scalar code is faster than matrix calls
BOX_PIVOT = 1e-12  # relative size below which a pivot is replaced: the direction then still descends


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


def in_reverse(stacked: ca.MX, stages: int) -> ca.MX:
    """Return the blocks of the stages in reverse order."""
    return ca.horzcat(*reversed(ca.horzsplit(stacked, stacked.shape[1] // stages))) if stages > 1 else stacked
