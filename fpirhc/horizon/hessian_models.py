"""The stage of a horizon expanded around a trajectory, for second-order sweeps, whole and in parts.

    s+ = F(s, u, theta),   A = dF/ds,  B = dF/du,   l_s, l_u,   and the second derivatives Q = l_ss, S = l_us, R = l_uu.

Loops in C call the parts: `evaluate` gives the stage with the entries m of its Jacobian, of which `pull` and `linearise` make the
rest; `bend` and `curve` do the work of `hessian_stage`. Theory: docs/theory.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import casadi as ca

from fpirhc.fields.checked import Checked
from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.evaluate import Latest


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
        return cost


@dataclass(frozen=True)
class ExactHessian(HessianModel):
    """The Hessian of the stage's Hamiltonian: quadratic convergence near a strict minimum, indefinite far from it.

    It sees the curvature that the dynamics give to a cost that has none of its own, such as a production rate.
    """

    needs_convex_cost = False

    def curved(self, cost: ca.SX, next_state: ca.SX, costate: ca.SX) -> ca.SX:
        """Return l + lambda' F."""
        return cost + ca.dot(costate, next_state)


def linear_stage(ocp: OptimalControl) -> ca.Function:
    """Function (s, u, theta) -> (s+, l, A (ns, ns), B (ns, nu), l_s, l_u)."""
    s, u, theta = ocp.dynamics.sx_in()
    next_state, (cost, _) = ocp.dynamics(s, u, theta), ocp.stage_cost(s, u, theta)
    jacobians = [ca.jacobian(next_state, s), ca.jacobian(next_state, u)]
    gradients = [ca.gradient(cost, s), ca.gradient(cost, u)]
    return _dense("fpirhc_linear_stage", [s, u, theta], [next_state, cost, *jacobians, *gradients])


def hessian_stage(ocp: OptimalControl, hessian: HessianModel) -> ca.Function:
    """Function (s, u, theta, lambda of s+) -> (Q (ns, ns), S (nu, ns), R (nu, nu))."""
    s, u, theta = ocp.dynamics.sx_in()
    costate = ca.SX.sym("lambda", ocp.state.size)
    curved = hessian.curved(ocp.stage_cost(s, u, theta)[0], ocp.dynamics(s, u, theta), costate)
    slope = ca.gradient(curved, u)
    results = [ca.hessian(curved, s)[0], ca.jacobian(slope, s), ca.jacobian(slope, u)]
    return _dense("fpirhc_hessian_stage", [s, u, theta, costate], results)


def hessian_end(ocp: OptimalControl) -> ca.Function:
    """Function (s_N, theta_N) -> (T, T_s, T_ss)."""
    s, _, theta = ocp.dynamics.sx_in()
    final = ocp.terminal_cost(s, theta)
    hessian, slope = ca.hessian(final, s)
    return _dense("fpirhc_hessian_end", [s, theta], [final, slope, hessian])


def _dense(name: str, arguments: list[ca.SX], results: list[ca.SX]) -> ca.Function:
    return ca.Function(name, arguments, ca.cse([ca.densify(r) for r in results]))


_Parts = dict[str, ca.Function]
_STAGES: Latest[_Parts] = Latest(8)  # horizons that differ in their data only have one stage
_HESSIANS: Latest[_Parts] = Latest(8)


def split_stage(ocp: OptimalControl) -> _Parts:
    """Return the Functions evaluate, pull and linearise, built once for a stage."""
    return _STAGES.of((ocp.dynamics, ocp.stage_cost), (), lambda: _split(ocp))


def partial_count(ocp: OptimalControl) -> int:
    """Return the number m of entries of a stage's Jacobian that are kept."""
    return int(split_stage(ocp)["pull"].numel_in(0))


def split_hessian(ocp: OptimalControl, hessian: HessianModel) -> _Parts:
    """Return the Functions bend and curve of a model of the second derivatives, built once for a stage."""
    return _HESSIANS.of((ocp.dynamics, ocp.stage_cost), (hessian,), lambda: _bent(ocp, hessian))


def _kept(matrix: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """The entries of a matrix that are not constant, symbols for them, and the matrix made of the symbols."""
    entries = [matrix.nz[k] for k in range(matrix.nnz())]
    varying = [k for k, e in enumerate(entries) if not ca.SX(e).is_constant()]
    symbols = ca.SX.sym("m", max(1, len(varying)))
    for place, k in enumerate(varying):
        entries[k] = symbols[place]
    values = ca.vertcat(*(matrix.nz[k] for k in varying)) if varying else ca.SX.zeros(1)
    return values, symbols, ca.SX(matrix.sparsity(), ca.vertcat(*entries)) if entries else matrix


def _split(ocp: OptimalControl) -> _Parts:
    ns = ocp.state.size
    s, u, theta = ocp.dynamics.sx_in()
    next_state, (cost, _) = ocp.dynamics(s, u, theta), ocp.stage_cost(s, u, theta)
    values, symbols, jacobian = _kept(ca.jacobian(ca.vertcat(next_state, cost), ca.vertcat(s, u)))
    after = ca.SX.sym("lambda", ns)
    pulled = ca.mtimes(jacobian.T, ca.vertcat(after, 1))
    rates, slopes = jacobian[:ns, :], jacobian[ns, :].T
    return {
        "evaluate": _dense("fpirhc_evaluate_stage", [s, u, theta], [next_state, cost, values]),
        "pull": _dense("fpirhc_pull_stage", [symbols, after], [pulled[:ns], pulled[ns:]]),
        "linearise": _dense(
            "fpirhc_linearise_stage", [symbols], [rates[:, :ns], rates[:, ns:], slopes[:ns], slopes[ns:]]
        ),
    }


def _bent(ocp: OptimalControl, hessian: HessianModel) -> _Parts:
    ns = ocp.state.size
    s, u, theta = ocp.dynamics.sx_in()
    after, variables = ca.SX.sym("lambda", ns), ca.vertcat(s, u)
    cost = ocp.stage_cost(s, u, theta)[0]
    curved = ca.hessian(hessian.curved(cost, ocp.dynamics(s, u, theta), after), variables)[0]
    values, symbols, lower = _kept(ca.tril(curved))
    whole = ca.tril2symm(lower)
    return {
        "bend": _dense("fpirhc_bend_stage", [s, u, theta, after], [values]),
        "curve": _dense("fpirhc_curve_stage", [symbols], [whole[:ns, :ns], whole[ns:, :ns], whole[ns:, ns:]]),
    }
