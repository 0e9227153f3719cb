"""The expansion of a stage in parts, for loops that need its Jacobians later, or not at all.

    evaluate   (s, u, theta) -> (s+, l, m),           m: the partial derivatives of the stage's elementary operations
    pull       (m, lambda of s+) -> (A' lambda + l_s, B' lambda + l_u)
    linearise  m -> (A, B, l_s, l_u)
    bend       (s, u, theta, lambda of s+) -> n,      n: those of the gradient of a Hessian model's scalar
    curve      n -> (Q, S, R)

Together they do the work of `linear_stage` and `hessian_stage` in `fpirhc.horizon.hessian_models` with fewer operations, and repeat
nothing (`fpirhc.symbolic.chain_rule`).
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import casadi as ca

from fpirhc.horizon.hessian_models import HessianModel, stage_symbols
from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.chain_rule import chain_rule

_Parts = dict[str, ca.Function]
_stages: WeakKeyDictionary[OptimalControl, _Parts] = WeakKeyDictionary()
_hessians: WeakKeyDictionary[OptimalControl, dict[HessianModel, _Parts]] = WeakKeyDictionary()


def split_stage(ocp: OptimalControl) -> dict[str, ca.Function]:
    """Return the Functions evaluate, pull and linearise, built once for a problem."""
    if ocp not in _stages:
        _stages[ocp] = _split(ocp)
    return _stages[ocp]


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
        "bend": _dense("bend", [s, u, theta, after], [parts.partials]),
        "curve": _dense("curve", [parts.symbols], [whole[:ns, :ns], whole[ns:, :ns], whole[ns:, ns:]]),
    }


def _split(ocp: OptimalControl) -> _Parts:
    ns, nu = ocp.state.size, ocp.input.size
    s, u, theta = stage_symbols(ocp)
    next_state, (cost, _) = ocp.dynamics(s, u, theta), ocp.stage_cost(s, u, theta)
    parts = chain_rule(ca.densify(ca.vertcat(next_state, cost)), ca.vertcat(s, u), theta)
    after = ca.SX.sym("lambda", ns)
    pulled = ca.substitute(parts.pulled, parts.weights, ca.vertcat(after, 1))
    rates, slopes = parts.jacobian[:ns, :], parts.jacobian[ns, :].T
    blocks = [rates[:, :ns], rates[:, ns:], slopes[:ns], slopes[ns:]]
    return {
        "evaluate": _dense("evaluate", [s, u, theta], [next_state, cost, parts.partials]),
        "pull": _dense("pull", [parts.symbols, after], [pulled[:ns], pulled[ns : ns + nu]]),
        "linearise": _dense("linearise", [parts.symbols], blocks),
    }


def _dense(name: str, arguments: list[ca.SX], results: list[ca.SX]) -> ca.Function:
    return ca.Function(f"fpirhc_{name}_stage", arguments, ca.cse([ca.densify(r) for r in results]))
