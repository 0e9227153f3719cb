"""The line search of `FixedPoint`: one plan per iteration is tried, and the best one so far is the anchor.

The search is built from Functions of a whole horizon, so that an iteration adds calls to the graph, and no copies.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.horizon.hessian_models import HessianModel, hessian_end, hessian_stage, linear_stage, stage_symbols
from fpirhc.horizon.live_data import STEEPEST
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.riccati import backward_sweep
from fpirhc.optimisers.anchor import SHARE, SHORTEST, Anchor, Arguments, Expanded
from fpirhc.optimisers.judgement import judgement
from fpirhc.symbolic.live import Number


def first_gamma(ocp: OptimalControl, data: ca.MX | None = None) -> float | ca.MX:
    """Return a gamma that is short enough near the reference: SHARE / L in the metric of D.

    Where settings are live, L stands in the data of the stages.
    """
    if ocp.settings and data is not None:
        return SHARE / data[ocp.data.slice(STEEPEST), 0]
    return SHARE / ocp.steepest


class Search:
    """Builds the expressions of the iteration.

    Args:
        ocp: the problem.
        hessian: second derivatives of the quadratic model.
        map: the deformation that makes the next plan.
        damping: added to the curvature of the inputs, in units of it.
    """

    def __init__(self, ocp: OptimalControl, hessian: HessianModel, map: Deformation, damping: Number) -> None:
        self._ocp = ocp
        self._expand, self._try = _expansion(ocp), _trial(ocp)
        self._judge = judgement(ocp)
        self._direct = _direction(ocp, hessian, map, damping)

    def tried(self, anchor: Anchor, arguments: Arguments) -> tuple[Anchor, Expanded]:
        """Return the anchor after its next plan was tried, and that plan expanded."""
        tried = self._try(arguments.s0, arguments.data, arguments.lower, arguments.upper, *anchor[:5], anchor.step)
        inputs, states, costs, a, b, by_state, by_input = tried
        value, slope, costates = self._expand(states, inputs, costs, arguments.data, a, b, by_state, by_input)
        live = [self._ocp.scale_in(arguments.data)] if self._ocp.settings else []
        judged = self._judge(inputs, states, value, slope, arguments.lower, arguments.upper, *anchor, *live)
        *fields, accepted = judged
        return Anchor(*fields), Expanded(inputs, states, a, b, by_state, by_input, costates, accepted)

    def directed(self, anchor: Anchor, plan: Expanded, arguments: Arguments) -> Anchor:
        """Return the anchor with the direction of a sweep where the last plan was accepted, else with its old direction."""
        move, gains = self._direct(*plan[:7], arguments.data, arguments.lower, arguments.upper)
        return anchor._replace(
            move=ca.if_else(plan.accepted, move, anchor.move), gains=ca.if_else(plan.accepted, gains, anchor.gains)
        )


def _trial(ocp: OptimalControl) -> ca.Function:
    """Function (s0, data, lower, upper, U, X, v, K, T, tau) -> (U, X (ns, N + 1), costs, A, B, l_s, l_u) of the next plan."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    s, _, theta = stage_symbols(ocp)
    inputs, move, plain = (ca.SX.sym(name, nu) for name in ("u", "v", "t"))
    planned, gain, step = ca.SX.sym("x", ns), ca.SX.sym("K", nu, ns), ca.SX.sym("tau")
    low, high = ca.SX.sym("low", nu), ca.SX.sym("high", nu)
    newton = ca.fmin(ca.fmax(inputs + step * move + gain @ (s - planned), low), high)
    used = ca.if_else(step >= SHORTEST, newton, plain)
    next_state, cost, *rest = linear_stage(ocp)(s, used, theta)
    stage = ca.Function(
        "fpirhc_trial_stage",
        [s, theta, low, high, inputs, planned, move, gain, plain, step],
        [next_state, used, cost, *rest],
    )
    sweep = stage.mapaccum("fpirhc_trial_stages", n)
    s0, data = ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
    lower, upper, tau = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu), ca.MX.sym("tau")
    plans = [ca.MX.sym(f"p{k}", *shape) for k, shape in enumerate([(nu, n), (ns, n), (nu, n), (nu, ns * n), (nu, n)])]
    repeated = [ca.repmat(v, 1, n) for v in (lower, upper, tau)]
    u, x, v, k, t = plans
    states, *results = sweep(s0, data[:, :n], repeated[0], repeated[1], u, x, v, k, t, repeated[2])
    arguments = [s0, data, lower, upper, *plans, tau]
    chosen_inputs, *stages = results
    return ca.Function("fpirhc_trial", arguments, [chosen_inputs, ca.horzcat(s0, states), *stages])


def _expansion(ocp: OptimalControl) -> ca.Function:
    """Function (X, U, costs, data, A, B, l_s, l_u) -> (V, g, costates of s_1 ... s_N)."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    costate, a, b = ca.SX.sym("lambda", ns), ca.SX.sym("A", ns, ns), ca.SX.sym("B", ns, nu)
    by_state, by_input = ca.SX.sym("ls", ns), ca.SX.sym("lu", nu)
    stage = ca.Function(
        "fpirhc_costate_stage",
        [costate, a, b, by_state, by_input],
        [by_state + a.T @ costate, by_input + b.T @ costate, costate],
    )
    states, inputs = ca.MX.sym("X", ns, n + 1), ca.MX.sym("U", nu, n)
    costs, data = ca.MX.sym("l", 1, n), ca.MX.sym("data", ocp.data.size, n + 1)
    stacked = [ca.MX.sym(f"m{k}", rows, columns * n) for k, (rows, columns) in enumerate(_stage_shapes(ns, nu))]
    final, last, _ = hessian_end(ocp)(states[:, n], data[:, n])
    turned = [_turned(m, n) for m in stacked]
    _, slope, costates = stage.mapaccum("fpirhc_costate_stages", n)(last, *turned)
    results = [ca.sum2(costs) + final, _turned(slope, n), _turned(costates, n)]
    return ca.Function("fpirhc_expansion", [states, inputs, costs, data, *stacked], results)


def _direction(ocp: OptimalControl, hessian: HessianModel, map: Deformation, damping: Number) -> ca.Function:
    """Function (U, X, A, B, l_s, l_u, costates, data, lower, upper) -> (v, K): the deformed feedforward and its feedback."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    inputs, states = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1)
    stacked = [ca.MX.sym(f"m{k}", rows, columns * n) for k, (rows, columns) in enumerate(_stage_shapes(ns, nu))]
    costates, data = ca.MX.sym("lambda", ns, n), ca.MX.sym("data", ocp.data.size, n + 1)
    lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
    hessians = hessian_stage(ocp, hessian).map(n)(states[:, :n], inputs, data[:, :n], costates)
    _, slope, value = hessian_end(ocp)(states[:, n], data[:, n])
    bounds = ca.repmat(lower, 1, n), ca.repmat(upper, 1, n)
    damped = [ocp.number_in(damping, data) / ocp.scale_in(data)] if ocp.settings else []
    move, gains = backward_sweep(ocp, damping)(*stacked, *hessians, inputs, *bounds, value, slope, *damped)
    results = [ca.reshape(deformed_move(map, nu * n)(ca.vec(move)), nu, n), gains]
    return ca.Function("fpirhc_direction", [inputs, states, *stacked, costates, data, lower, upper], results)


def deformed_move(map: Deformation, size: int) -> ca.Function:
    """Function v -> G(0, -v, 0): the deformed feedforward."""
    column = ca.SX.sym("v", size)
    deformed, _ = map.step(ca.SX.zeros(size), -column, ca.SX.zeros(size), {})
    return ca.Function("fpirhc_deformed_move", [column], [ca.densify(deformed)])


def _stage_shapes(ns: int, nu: int) -> tuple[tuple[int, int], ...]:
    return (ns, ns), (ns, nu), (ns, 1), (nu, 1)


def _turned(stacked: ca.MX, stages: int) -> ca.MX:
    """The blocks of the stages in reverse order."""
    return ca.horzcat(*reversed(ca.horzsplit(stacked, stacked.shape[1] // stages))) if stages > 1 else stacked
