"""The auxiliary function of constrained optimisation on a horizon, after Lagrange.

    Psi(S, U, mu) = V(S, U) + sum_{i<N} mu_i' (s_{i+1} - F(s_i, u_i)),    z = (S, U, mu),

where S = (s_1 ... s_N) are unknowns and the dynamics are constraints. At a solution grad Psi = 0. Its Hessian is the KKT matrix:
symmetric and indefinite, with inertia (N (ns + nu), N ns).
"""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.problem import OptimalControl


def auxiliary(ocp: OptimalControl) -> ca.Function:
    """Function (S (ns, N), U (nu, N), mu (ns, N), s0, data) -> Psi."""
    n = ocp.stages
    states, inputs = ca.MX.sym("S", ocp.state.size, n), ca.MX.sym("U", ocp.input.size, n)
    multipliers = ca.MX.sym("mu", ocp.state.size, n)
    s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, n + 1)
    before = ca.horzcat(s0, states[:, : n - 1])
    next_states = ocp.dynamics.map(n)(before, inputs, data[:, :n])
    costs, _ = ocp.stage_cost.map(n)(before, inputs, data[:, :n])
    value = ca.sum2(costs) + ocp.terminal_cost(states[:, n - 1], data[:, n])
    value += ca.dot(multipliers, states - next_states)
    names = ["S", "U", "mu", "s0", "data"]
    return ca.Function("fpirhc_auxiliary", [states, inputs, multipliers, s0, data], [value], names, ["psi"])


def auxiliary_gradient(ocp: OptimalControl) -> ca.Function:
    """Function (S, U, mu, s0, data) -> gradients of Psi with respect to S, U and mu, shaped like them."""
    psi = auxiliary(ocp)
    symbols = [ca.MX.sym(psi.name_in(k), *psi.size_in(k)) for k in range(psi.n_in())]
    value = psi(*symbols)
    gradients = [ca.gradient(value, v) for v in symbols[:3]]
    return ca.Function("fpirhc_auxiliary_gradient", symbols, gradients, psi.name_in(), ["dS", "dU", "dmu"])


def auxiliary_hessian(ocp: OptimalControl) -> ca.Function:
    """Function (S, U, mu, s0, data) -> Hessian of Psi with respect to z = (vec S, vec U, vec mu), symmetric."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    z = ca.MX.sym("z", n * (2 * ns + nu))
    s0, data = ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
    states, inputs, multipliers = ca.vertsplit(z, [0, n * ns, n * (ns + nu), n * (2 * ns + nu)])
    shaped = (ca.reshape(states, ns, n), ca.reshape(inputs, nu, n), ca.reshape(multipliers, ns, n))
    hessian, _ = ca.hessian(auxiliary(ocp)(*shaped, s0, data), z)
    flat = ca.Function("fpirhc_hessian", [z, s0, data], [hessian])
    arguments = [ca.MX.sym(name, rows, n) for name, rows in (("S", ns), ("U", nu), ("mu", ns))]
    packed = ca.vertcat(*(ca.vec(v) for v in arguments))
    return ca.Function("fpirhc_auxiliary_hessian", [*arguments, s0, data], [flat(packed, s0, data)])
