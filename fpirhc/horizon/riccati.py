"""One backward sweep that solves the horizon's quadratic model stage by stage, with the input box kept.

With the cost to go of stage i+1 modelled by 1/2 dx'P dx + p'dx, stage i minimises over v in [lower - u, upper - u]

    Q_u' v + 1/2 v' Q_uu v,      Q_u = l_u + B'p,   Q_uu = R + B'P B + mu D^-1,   Q_us = S + B'P A,

a box QP of the size of the input. Inputs that end at a bound get no feedback; the others get K = -Q_uu^-1 Q_us on the free
set. The policy is du = v + K dx and the cost to go becomes P <- Q + A'PA + Q_us'K, p <- Q_s + Q_us'v + K'(Q_u + Q_uu v).
Without active bounds the feedforward v, rolled out through the linear model with K, is exactly -M^-1 g with M the Hessian of the
quadratic model: a full time-coupled preconditioner for the price of N small factorisations.

References: D. Q. Mayne, Int. J. Control 3(1), 1966; Y. Tassa, N. Mansard, E. Todorov, Control-Limited Differential Dynamic
Programming, IEEE ICRA 2014.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.expression import kind

_SCALAR_CODE = 1000  # multiplications of one stage up to which scalar code beats matrix calls
PIVOT = 1e-12  # relative size below which a pivot is replaced: the direction then still descends


def rounds(inputs: int) -> int:
    """Active-set changes that a stage's box QP is allowed."""
    return 2 * inputs if inputs > 1 else 1


def backward_sweep(ocp: OptimalControl, damping: float) -> ca.Function:
    """Function (stage columns, P_N, p_N) -> (v (nu, N), K (nu, ns N)).

    The stage columns, each stacked over the stages, are A, B, l_s, l_u, Q, S, R, U, lower, upper.
    """
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    shapes = {"A": ns, "B": nu, "ls": 1, "lu": 1, "Q": ns, "S": ns, "R": nu, "U": 1, "lower": 1, "upper": 1}
    rows = {"A": ns, "B": ns, "ls": ns, "lu": nu, "Q": ns, "S": nu, "R": nu, "U": nu, "lower": nu, "upper": nu}
    stacked = [ca.MX.sym(name, rows[name], columns * n) for name, columns in shapes.items()]
    value, slope = ca.MX.sym("P", ns, ns), ca.MX.sym("p", ns)
    sweep = _stage(ocp, damping).mapaccum("fpirhc_riccati_stages", n, 2)
    turned = [_reverse(column, width, n) for column, width in zip(stacked, shapes.values(), strict=True)]
    _, _, moves, gains = sweep(value, slope, *turned)
    results = [_reverse(moves, 1, n), _reverse(gains, ns, n)]
    names = [*shapes, "P", "p"]
    return ca.Function("fpirhc_riccati", [*stacked, value, slope], results, names, ["v", "K"])


def _reverse(stacked: ca.MX, width: int, stages: int) -> ca.MX:
    return ca.horzcat(*reversed(ca.horzsplit(stacked, width))) if stages > 1 else stacked


def _stage(ocp: OptimalControl, damping: float) -> ca.Function:
    """Function (P, p, A, B, l_s, l_u, Q, S, R, u, lower, upper) -> (P, p, v, K)."""
    ns, nu = ocp.state.size, ocp.input.size
    sym = kind(opaque=ns * ns * (ns + nu) > _SCALAR_CODE).sym
    value, slope = sym("P", ns, ns), sym("p", ns)
    a, b, by_state, by_input = sym("A", ns, ns), sym("B", ns, nu), sym("ls", ns), sym("lu", nu)
    q, s, r = sym("Q", ns, ns), sym("S", nu, ns), sym("R", nu, nu)
    u, lower, upper = sym("u", nu), sym("lower", nu), sym("upper", nu)
    ahead = ca.mtimes(value, a)
    damped = r + ca.mtimes(b.T, ca.mtimes(value, b)) + ca.DM(np.diag(damping * ocp.step * ocp.curvature))
    coupled = s + ca.mtimes(b.T, ahead)
    steep = by_input + ca.mtimes(b.T, slope)
    move, gain = box_policy(nu, ns)(steep, damped, coupled, lower - u, upper - u)
    following = q + ca.mtimes(a.T, ahead) + ca.mtimes(coupled.T, gain)
    leaning = by_state + ca.mtimes(a.T, slope) + ca.mtimes(coupled.T, move)
    leaning += ca.mtimes(gain.T, steep + ca.mtimes(damped, move))
    arguments = [value, slope, a, b, by_state, by_input, q, s, r, u, lower, upper]
    return ca.Function("fpirhc_riccati_stage", arguments, [0.5 * (following + following.T), leaning, move, gain])


def box_policy(nu: int, ns: int) -> ca.Function:
    """Function (Q_u, Q_uu, Q_us, low, high) -> (v, K): the stage's box QP by projected Newton steps, and its feedback.

    Of all rounds the best move is taken, so that it is never worse than v = 0, and v = 0 stays only where the bound-constrained
    first-order conditions hold.
    """
    slope, bend, coupled = ca.SX.sym("Qu", nu), ca.SX.sym("Quu", nu, nu), ca.SX.sym("Qus", nu, ns)
    low, high = ca.SX.sym("low", nu), ca.SX.sym("high", nu)
    move, best, lowest = ca.SX.zeros(nu), ca.SX.zeros(nu), ca.SX(0)
    for _ in range(rounds(nu)):
        free = _free(move, slope + bend @ move, low, high)
        target = -(slope + bend @ ((1 - free) * move))
        wanted = solve_free(bend, free, target)
        move = ca.fmin(ca.fmax(free * wanted + (1 - free) * move, low), high)
        value = ca.dot(slope + 0.5 * (bend @ move), move)
        better = value < lowest
        best, lowest = ca.if_else(better, move, best), ca.if_else(better, value, lowest)
    free = _free(best, slope + bend @ best, low, high)
    gain = solve_free(bend, free, -coupled)
    return ca.Function("fpirhc_box_policy", [slope, bend, coupled, low, high], ca.cse([best, gain]))


def _free(move: ca.SX, slope: ca.SX, low: ca.SX, high: ca.SX) -> ca.SX:
    """1 where an input can still improve, 0 where its bound holds it back."""
    held = ca.logic_or(ca.logic_and(move <= low, slope > 0), ca.logic_and(move >= high, slope < 0))
    return ca.if_else(held, 0, 1)


def solve_free(bend: ca.SX, free: ca.SX, right: ca.SX) -> ca.SX:
    """Solve the free rows and columns by L D L'; rows that are not free come out as zero.

    A pivot that is not positive is replaced by the size of its diagonal entry, so that the result is still a descent direction.
    """
    n = bend.shape[0]
    lower, pivots = ca.SX.eye(n), list[ca.SX]()
    for j in range(n):
        known = sum((lower[j, k] ** 2 * pivots[k] for k in range(j)), start=ca.SX(0))
        pivot = free[j] * (bend[j, j] - known) + (1 - free[j])
        size = ca.fabs(bend[j, j]) + 1e-300
        pivots.append(ca.if_else(pivot > PIVOT * size, pivot, size))
        for i in range(j + 1, n):
            known = sum((lower[i, k] * lower[j, k] * pivots[k] for k in range(j)), start=ca.SX(0))
            lower[i, j] = free[i] * free[j] * (bend[i, j] - known) / pivots[j]
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
