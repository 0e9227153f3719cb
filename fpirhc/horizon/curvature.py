"""How strongly the cost bends along each input: the scale that makes a gradient comparable to an input.

    c_k = (1 / step) d^2 V / d u_0k^2   with the dynamics linearised along the reference (Gauss-Newton),

so that g_k / (step c_k) has the unit of the input whatever the units and the weights of the cost are.
"""

from __future__ import annotations

import casadi as ca
import numpy as np


def input_curvature(
    dynamics: ca.Function,
    stage_cost: ca.Function,
    terminal_cost: ca.Function,
    step: float,
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return c (nu,), positive; `nodes` are states (ns, N + 1), inputs (nu, N) and data (ntheta, N + 1) to linearise at.

    An input along which the cost is flat there gets the largest curvature of the others, or 1 when all are flat.
    """
    states, inputs, data = nodes
    stages = inputs.shape[1]
    linearised = _linearised(dynamics, stage_cost)
    _, sensitivity, _, bend = linearised(states[:, 0], inputs[:, 0], data[:, 0])
    moved = np.asarray(sensitivity.full())
    total = np.asarray(bend.full()).diagonal().copy()
    for i in range(1, stages):
        a, _, q, _ = (np.asarray(v.full()) for v in linearised(states[:, i], inputs[:, i], data[:, i]))
        total += np.einsum("ik,ij,jk->k", moved, q, moved)
        moved = a @ moved
    final = np.asarray(_final(terminal_cost)(states[:, stages], data[:, stages]).full())
    total = np.abs(total + np.einsum("ik,ij,jk->k", moved, final, moved)) / step
    usable = np.isfinite(total) & (total > 0)
    return np.where(usable, total, total[usable].max() if usable.any() else 1.0)


def _linearised(dynamics: ca.Function, stage_cost: ca.Function) -> ca.Function:
    """Function (s, u, theta) -> (dF/ds, dF/du, d2l/ds2, d2l/du2)."""
    s, u, theta = (ca.SX.sym(n, dynamics.size1_in(k)) for k, n in enumerate(("s", "u", "theta")))
    following, cost = dynamics(s, u, theta), stage_cost(s, u, theta)[0]
    results = [ca.jacobian(following, s), ca.jacobian(following, u), ca.hessian(cost, s)[0], ca.hessian(cost, u)[0]]
    return ca.Function("fpirhc_linearised", [s, u, theta], results)


def _final(terminal_cost: ca.Function) -> ca.Function:
    """Function (s, theta) -> d2T/ds2."""
    s, theta = (ca.SX.sym(n, terminal_cost.size1_in(k)) for k, n in enumerate(("s", "theta")))
    return ca.Function("fpirhc_final", [s, theta], [ca.hessian(terminal_cost(s, theta), s)[0]])
