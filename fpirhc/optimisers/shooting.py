"""A horizon as a nonlinear program by direct multiple shooting.

variables    w = (s_0, u_0, s_1, ..., u_{N-1}, s_N),    constraints  s_{i+1} - F(s_i, u_i) = 0.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import shift


def program_values(ocp: OptimalControl) -> ca.Function:
    """Function (w, p) -> cost, constraints and their first derivatives in one column."""
    nlp = program(ocp)
    slopes = ca.gradient(nlp["f"], nlp["x"]), ca.jacobian(nlp["g"], nlp["x"])
    column = ca.vertcat(nlp["f"], nlp["g"], ca.densify(slopes[0]), ca.vec(slopes[1].nz[:]))
    return ca.Function("fpirhc_program_values", [nlp["x"], nlp["p"]], [column])


def sizes(ocp: OptimalControl) -> tuple[int, int]:
    """Return the numbers of variables and of constraints."""
    return ocp.stages * (ocp.state.size + ocp.input.size) + ocp.state.size, ocp.stages * ocp.state.size


def interleave(states: ca.MX, inputs: ca.MX) -> ca.MX:
    """Return states (ns, N + 1) and inputs (nu, N) as a column (s_0, u_0, s_1, ..., s_N)."""
    n = inputs.shape[1]
    return ca.vertcat(ca.vec(ca.vertcat(states[:, :n], inputs)), states[:, n])


def separate(ocp: OptimalControl, column: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return states (ns, N + 1) and inputs (nu, N) of a column: the inverse of `interleave`."""
    ns, nu, n = ocp.state.size, ocp.input.size, ocp.stages
    stages = ca.reshape(column[: n * (ns + nu)], ns + nu, n)
    return ca.horzcat(stages[:ns, :], column[n * (ns + nu) :]), stages[ns:, :]


def stage_bounds(ocp: OptimalControl, s0: ca.MX, bound: np.ndarray) -> ca.MX:
    """Return the bounds of s_0 ... s_N; the first state is fixed."""
    return ca.horzcat(s0, ca.repmat(ca.DM(bound), 1, ocp.stages))


def shift_variables(ocp: OptimalControl, column: ca.MX) -> ca.MX:
    """Return variables, or their multipliers, one stage later."""
    states, inputs = separate(ocp, column)
    return interleave(shift(states), shift(inputs))


def shift_dynamics(ocp: OptimalControl, column: ca.MX) -> ca.MX:
    """Return multipliers of the dynamics one stage later."""
    stages: ca.MX = ca.reshape(column, ocp.state.size, ocp.stages)
    return ca.vec(shift(stages))


def program(ocp: OptimalControl) -> dict[str, ca.MX]:
    """Return the program as CasADi's `nlpsol` takes it, with the data of all stages as its parameter."""
    n = ocp.stages
    w, flat = ca.MX.sym("w", sizes(ocp)[0]), ca.MX.sym("p", ocp.data.size * (n + 1))
    states, inputs = separate(ocp, w)
    data = ca.reshape(flat, ocp.data.size, n + 1)
    costs, _ = ocp.stage_cost.map(n)(states[:, :n], inputs, data[:, :n])
    value = ca.sum2(costs) + ocp.terminal_cost(states[:, n], data[:, n])
    next_states = ocp.dynamics.map(n)(states[:, :n], inputs, data[:, :n])
    return {"x": w, "p": flat, "f": value, "g": ca.vec(states[:, 1:] - next_states)}


def gauss_newton_hessian(ocp: OptimalControl) -> ca.Function:
    """Function (x, p, lam_f, lam_g) -> Hessian of the cost alone, block by block, with both triangles."""
    nlp = program(ocp)
    hessian, _ = ca.hessian(nlp["f"], nlp["x"])
    weight, multipliers = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", sizes(ocp)[1])
    inputs = [nlp["x"], nlp["p"], weight, multipliers]
    names = ["x", "p", "lam_f", "lam_g"]
    return ca.Function("nlp_hess_l", inputs, [weight * hessian], names, ["hess_gamma_x_x"])
