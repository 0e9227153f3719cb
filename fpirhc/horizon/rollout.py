"""Rolling the model out over a horizon, and the gradient of the cost by one backward sweep.

Theory: docs/theory-plants.md.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.problem import OptimalControl


def rollout(ocp: OptimalControl) -> ca.Function:
    """Function (s0, U (nu, N), data (ntheta, N + 1)) -> (S (ns, N + 1), V, cost by term summed over the stages)."""
    n = ocp.stages
    s0, inputs, data = _symbols(ocp)
    states, costs, terms = _forward(ocp).mapaccum("fpirhc_rollout_stages", n)(s0, inputs, data[:, :n])
    total = ca.sum2(costs) + ocp.terminal_cost(states[:, -1], data[:, n])
    results = [ca.horzcat(s0, states), total, ca.sum2(terms)]
    return ca.Function("fpirhc_rollout", [s0, inputs, data], results, ["s0", "U", "data"], ["S", "V", "terms"])


def reduced_gradient(ocp: OptimalControl) -> ca.Function:
    """Function (s0, U, data, M (ns, N)) -> (V, g (nu, N), S, costates (ns, N + 1)).

    M are multipliers of state bounds: g is then the gradient of V + sum_i M_i' s_{i+1}. Zero without state bounds.
    """
    n = ocp.stages
    s0, inputs, data = _symbols(ocp)
    multipliers = ca.MX.sym("M", ocp.state.size, n)
    states, total, _ = rollout(ocp)(s0, inputs, data)
    last = _terminal_gradient(ocp)(states[:, n], data[:, n]) + multipliers[:, n - 1]
    # Stage 0 has no state multiplier: its state is given.
    stage_multipliers = ca.horzcat(ca.MX.zeros(ocp.state.size, 1), multipliers[:, : n - 1])
    order = list(range(n - 1, -1, -1))
    sweep = _backward(ocp).mapaccum("fpirhc_adjoint_stages", n)
    costates, gradient = sweep(last, states[:, order], inputs[:, order], data[:, order], stage_multipliers[:, order])
    results = [total, gradient[:, order], states, ca.horzcat(costates[:, order], last)]
    names = ["V", "g", "S", "costates"]
    return ca.Function("fpirhc_gradient", [s0, inputs, data, multipliers], results, ["s0", "U", "data", "M"], names)


def _symbols(ocp: OptimalControl) -> tuple[ca.MX, ca.MX, ca.MX]:
    return (
        ca.MX.sym("s0", ocp.state.size),
        ca.MX.sym("U", ocp.input.size, ocp.stages),
        ca.MX.sym("data", ocp.data.size, ocp.stages + 1),
    )


def _forward(ocp: OptimalControl) -> ca.Function:
    s, u, theta = (ca.SX.sym(n, k) for n, k in (("s", ocp.state.size), ("u", ocp.input.size), ("t", ocp.data.size)))
    cost, terms = ocp.stage_cost(s, u, theta)
    return ca.Function("fpirhc_forward_stage", [s, u, theta], [ocp.dynamics(s, u, theta), cost, terms])


def _backward(ocp: OptimalControl) -> ca.Function:
    s, u, theta = (ca.SX.sym(n, k) for n, k in (("s", ocp.state.size), ("u", ocp.input.size), ("t", ocp.data.size)))
    costate, multiplier = ca.SX.sym("lambda", ocp.state.size), ca.SX.sym("m", ocp.state.size)
    cost, _ = ocp.stage_cost(s, u, theta)
    weighted = cost + ca.dot(costate, ocp.dynamics(s, u, theta))
    by_state = ca.gradient(weighted, s) + multiplier
    by_input = ca.gradient(weighted, u)
    results = [ca.densify(by_state), ca.densify(by_input)]
    return ca.Function("fpirhc_backward_stage", [costate, s, u, theta, multiplier], results)


def _terminal_gradient(ocp: OptimalControl) -> ca.Function:
    s, theta = ca.SX.sym("s", ocp.state.size), ca.SX.sym("t", ocp.data.size)
    return ca.Function(
        "fpirhc_terminal_gradient", [s, theta], [ca.densify(ca.gradient(ocp.terminal_cost(s, theta), s))]
    )
