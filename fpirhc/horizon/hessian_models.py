"""The stage of a horizon expanded around a trajectory, for second-order sweeps.

    s+ = F(s, u, theta),   A = dF/ds,  B = dF/du,   l_s, l_u,   and the second derivatives Q = l_ss, S = l_us, R = l_uu.

`GaussNewton` uses the second derivatives of the cost and linear dynamics; they are positive semi-definite for convex stage costs
and every model. `ExactHessian` adds lambda' d^2F of the dynamics.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import casadi as ca

from fpirhc.fields.checked import Checked
from fpirhc.horizon.problem import OptimalControl


class HessianModel(Checked, ABC):
    """Contract: a model of a stage's second derivatives."""

    @property
    def needs_convex_cost(self) -> bool:
        """Whether the model says nothing useful of a cost that does not bend upwards."""
        return True

    @abstractmethod
    def curved(self, cost: ca.SX, next_state: ca.SX, costate: ca.SX) -> ca.SX:
        """Return the scalar whose Hessian with respect to (s, u) the sweep uses."""


@dataclass(frozen=True)
class GaussNewton(HessianModel):
    """The Hessian of the stage cost alone."""

    def curved(self, cost: ca.SX, next_state: ca.SX, costate: ca.SX) -> ca.SX:  # noqa: ARG002
        """Return l."""
        return cost


@dataclass(frozen=True)
class ExactHessian(HessianModel):
    """The Hessian of the stage's Hamiltonian: quadratic convergence near a strict minimum, indefinite far from it.

    It sees the curvature that the dynamics give to a cost that has none of its own, such as a production rate.
    """

    @property
    def needs_convex_cost(self) -> bool:
        """Whether the model needs a convex cost: it does not, because it is the curvature of the whole problem."""
        return False

    def curved(self, cost: ca.SX, next_state: ca.SX, costate: ca.SX) -> ca.SX:
        """Return l + lambda' F."""
        return cost + ca.dot(costate, next_state)


def linear_stage(ocp: OptimalControl) -> ca.Function:
    """Function (s, u, theta) -> (s+, l, A (ns, ns), B (ns, nu), l_s, l_u)."""
    s, u, theta = stage_symbols(ocp)
    next_state, (cost, _) = ocp.dynamics(s, u, theta), ocp.stage_cost(s, u, theta)
    jacobians = [ca.jacobian(next_state, s), ca.jacobian(next_state, u)]
    gradients = [ca.gradient(cost, s), ca.gradient(cost, u)]
    return _dense("fpirhc_linear_stage", [s, u, theta], [next_state, cost, *jacobians, *gradients])


def hessian_stage(ocp: OptimalControl, hessian: HessianModel) -> ca.Function:
    """Function (s, u, theta, lambda of s+) -> (Q (ns, ns), S (nu, ns), R (nu, nu))."""
    s, u, theta = stage_symbols(ocp)
    costate = ca.SX.sym("lambda", ocp.state.size)
    cost, _ = ocp.stage_cost(s, u, theta)
    curved = hessian.curved(cost, ocp.dynamics(s, u, theta), costate)
    slope = ca.gradient(curved, u)
    results = [ca.hessian(curved, s)[0], ca.jacobian(slope, s), ca.jacobian(slope, u)]
    return _dense("fpirhc_hessian_stage", [s, u, theta, costate], results)


def hessian_end(ocp: OptimalControl) -> ca.Function:
    """Function (s_N, theta_N) -> (T, T_s, T_ss)."""
    s, _, theta = stage_symbols(ocp)
    final = ocp.terminal_cost(s, theta)
    hessian, slope = ca.hessian(final, s)
    return _dense("fpirhc_hessian_end", [s, theta], [final, slope, hessian])


def stage_symbols(ocp: OptimalControl) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Symbols (s, u, theta) of one stage."""
    return ca.SX.sym("s", ocp.state.size), ca.SX.sym("u", ocp.input.size), ca.SX.sym("theta", ocp.data.size)


def _dense(name: str, arguments: list[ca.SX], results: list[ca.SX]) -> ca.Function:
    return ca.Function(name, arguments, ca.cse([ca.densify(r) for r in results]))
