"""The stage of a horizon expanded around a trajectory, for second-order sweeps, whole and in parts.

    s+ = F(s, u, theta),   A = dF/ds,  B = dF/du,   l_s, l_u,   and the second derivatives Q = l_ss, S = l_us, R = l_uu.

Loops in C call the parts, because they need Jacobians later, or not at all: `evaluate` and `pull` do the work of `linear_stage`,
`bend` and `curve` that of `hessian_stage`, with fewer operations and nothing twice (`fpirhc.symbolic.chain_rule`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import casadi as ca

from fpirhc.fields.checked import Checked
from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.chain_rule import ChainRule, chain_rule, slopes_function, tangent_code

_MANY = 16  # directions from which on loops over all of them beat scalar code: 24 directions took .76 of the time, 12 took 1.03


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


_Parts = dict[str, ca.Function]
_rules: WeakKeyDictionary[OptimalControl, ChainRule] = WeakKeyDictionary()
_stages: WeakKeyDictionary[OptimalControl, _Parts] = WeakKeyDictionary()
_hessians: WeakKeyDictionary[OptimalControl, dict[HessianModel, _Parts]] = WeakKeyDictionary()


def split_stage(ocp: OptimalControl) -> dict[str, ca.Function]:
    """Return the Functions evaluate and pull, built once for a problem."""
    if ocp not in _stages:
        _stages[ocp] = _split(ocp)
    return _stages[ocp]


def linearise_stage(ocp: OptimalControl) -> ca.Function:
    """Return the Function linearise as scalar code."""
    parts = split_stage(ocp)
    if "linearise" not in parts:
        ns, rule = ocp.state.size, _rules[ocp]
        rates, slopes = rule.jacobian[:ns, :], rule.jacobian[ns, :].T
        results = [rates[:, :ns], rates[:, ns:], slopes[:ns], slopes[ns:]]
        parts["linearise"] = _dense("fpirhc_linearise_stage", [rule.symbols], results)
    return parts["linearise"]


def stage_leaves(ocp: OptimalControl, names: tuple[str, ...]) -> tuple[_Parts, str]:
    """Return what a driver in C calls and C code to stand before it, which together provide `linearise` and the parts named.

    Args:
        names: evaluate, pull.
    """
    parts = split_stage(ocp)
    leaves = {name: parts[name] for name in names}
    sizes = ocp.state.size, ocp.input.size
    if sum(sizes) <= _MANY:
        return {**leaves, "linearise": linearise_stage(ocp)}, ""
    rule = _rules[ocp]
    leaves["slopes"] = slopes_function(rule, "fpirhc_slopes")
    return leaves, tangent_code(rule, "linearise", "slopes", sizes)


def partial_count(ocp: OptimalControl) -> int:
    """Return the number of partial derivatives m of a stage."""
    return int(split_stage(ocp)["pull"].numel_in(0))


def split_hessian(ocp: OptimalControl, hessian: HessianModel) -> dict[str, ca.Function]:
    """Return the Functions bend and curve of a model of the second derivatives, built once for a problem."""
    models = _hessians.setdefault(ocp, {})
    if hessian not in models:
        models[hessian] = _bent(ocp, hessian)
    return models[hessian]


def _bent(ocp: OptimalControl, hessian: HessianModel) -> _Parts:
    ns = ocp.state.size
    s, u, theta = stage_symbols(ocp)
    after, variables = ca.SX.sym("lambda", ns), ca.vertcat(s, u)
    cost, _ = ocp.stage_cost(s, u, theta)
    slope = ca.gradient(hessian.curved(cost, ocp.dynamics(s, u, theta), after), variables)
    parts = chain_rule(ca.cse(ca.densify(slope)), variables, ca.vertcat(theta, after))
    # Only the lower triangle is computed.
    whole = ca.tril2symm(ca.tril(parts.jacobian))
    return {
        "bend": _dense("fpirhc_bend_stage", [s, u, theta, after], [parts.partials]),
        "curve": _dense("fpirhc_curve_stage", [parts.symbols], [whole[:ns, :ns], whole[ns:, :ns], whole[ns:, ns:]]),
    }


def _split(ocp: OptimalControl) -> _Parts:
    ns, nu = ocp.state.size, ocp.input.size
    s, u, theta = stage_symbols(ocp)
    next_state, (cost, _) = ocp.dynamics(s, u, theta), ocp.stage_cost(s, u, theta)
    parts = _rules[ocp] = chain_rule(ca.densify(ca.vertcat(next_state, cost)), ca.vertcat(s, u), theta)
    after = ca.SX.sym("lambda", ns)
    pulled = ca.substitute(parts.pulled, parts.weights, ca.vertcat(after, 1))
    return {
        "evaluate": _dense("fpirhc_evaluate_stage", [s, u, theta], [next_state, cost, parts.partials]),
        "pull": _dense("fpirhc_pull_stage", [parts.symbols, after], [pulled[:ns], pulled[ns : ns + nu]]),
    }
