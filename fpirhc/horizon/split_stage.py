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
from fpirhc.symbolic.chain_rule import ChainRule, chain_rule
from fpirhc.symbolic.tangents import slopes_function, tangent_code

_MANY = 16  # directions from which on loops over all of them beat scalar code: 24 directions took .76 of the time, 12 took 1.03
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
        parts["linearise"] = _dense(
            "linearise", [rule.symbols], [rates[:, :ns], rates[:, ns:], slopes[:ns], slopes[ns:]]
        )
    return parts["linearise"]


def stage_leaves(ocp: OptimalControl, names: tuple[str, ...]) -> tuple[_Parts, str]:
    """Return what a driver in C calls and C code to stand before it, which together provide `linearise` and the parts named.

    Args:
        ocp: the problem.
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
        "bend": _dense("bend", [s, u, theta, after], [parts.partials]),
        "curve": _dense("curve", [parts.symbols], [whole[:ns, :ns], whole[ns:, :ns], whole[ns:, ns:]]),
    }


def _split(ocp: OptimalControl) -> _Parts:
    ns, nu = ocp.state.size, ocp.input.size
    s, u, theta = stage_symbols(ocp)
    next_state, (cost, _) = ocp.dynamics(s, u, theta), ocp.stage_cost(s, u, theta)
    parts = _rules[ocp] = chain_rule(ca.densify(ca.vertcat(next_state, cost)), ca.vertcat(s, u), theta)
    after = ca.SX.sym("lambda", ns)
    pulled = ca.substitute(parts.pulled, parts.weights, ca.vertcat(after, 1))
    return {
        "evaluate": _dense("evaluate", [s, u, theta], [next_state, cost, parts.partials]),
        "pull": _dense("pull", [parts.symbols, after], [pulled[:ns], pulled[ns : ns + nu]]),
    }


def _dense(name: str, arguments: list[ca.SX], results: list[ca.SX]) -> ca.Function:
    return ca.Function(f"fpirhc_{name}_stage", arguments, ca.cse([ca.densify(r) for r in results]))
