"""The line search of `FixedPoint`: tries one plan per iteration and keeps the best so far, the anchor.

Built from Functions of a whole horizon, so that an iteration adds calls and no copies to the graph.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from fpirhc.deformation.base import Deformation
from fpirhc.horizon.hessian_models import HessianModel, hessian_end, hessian_stage, linear_stage, stage_symbols
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.reference_expansion import steepest_curvature
from fpirhc.horizon.riccati import backward_sweep
from fpirhc.optimisers.base import clip
from fpirhc.symbolic.expression import is_finite

SHARE = 0.95  # gamma L, and the share of the guaranteed decrease that is asked for
ARMIJO = 1e-2  # share of the first-order decrease that is asked of a short step
SHORTER = 0.25  # factor of the step after a plan that did not decrease the envelope
DRAWN_IN = 0.01  # least factor of gamma after a plain step that was rejected
SHORTEST = 0.05  # below it the plain fixed-point step is taken
ROUNDING = 1e-13  # relative to the cost: differences below it say nothing
TINY = 1e-300
UNTRIED = 1e299  # a cost from which on an anchor counts as not evaluated


class Arguments(NamedTuple):
    """The arguments of one call."""

    s0: ca.MX
    data: ca.MX
    lower: ca.MX
    upper: ca.MX


class Anchor(NamedTuple):
    """The best plan so far, where to go from it, and how boldly."""

    inputs: ca.MX  # U (nu, N)
    states: ca.MX  # X (ns, N)
    move: ca.MX  # v (nu, N)
    gains: ca.MX  # K (nu, ns N)
    plain: ca.MX  # T (nu, N)
    slope: ca.MX  # g (nu, N)
    value: ca.MX  # V
    envelope: ca.MX  # phi
    step: ca.MX  # tau; below SHORTEST the next plan is T
    gamma: ca.MX
    resume: ca.MX  # tau that follows the evaluation of a remembered plan


class Expanded(NamedTuple):
    """A plan that was tried, expanded."""

    inputs: ca.MX
    states: ca.MX  # (ns, N + 1)
    a: ca.MX
    b: ca.MX
    by_state: ca.MX
    by_input: ca.MX
    costates: ca.MX  # (ns, N), of s_1 ... s_N
    accepted: ca.MX


def first_gamma(ocp: OptimalControl) -> float:
    """Gamma that is safe near the reference: SHARE / L in the metric of D."""
    return SHARE / steepest_curvature(ocp.along, 1 / (ocp.step * ocp.curvature))


class Search:
    """Builds the expressions of the iteration for one problem."""

    def __init__(self, ocp: OptimalControl, hessian: HessianModel, map: Deformation, damping: float) -> None:
        self._ocp = ocp
        self._expand, self._try = _expansion(ocp), _trial(ocp)
        self._judge = _judgement(ocp)
        self._direct = _direction(ocp, hessian, map, damping)

    def tried(self, anchor: Anchor, arguments: Arguments) -> tuple[Anchor, Expanded]:
        """Try the anchor's next plan: the new anchor, and the plan expanded."""
        tried = self._try(arguments.s0, arguments.data, arguments.lower, arguments.upper, *anchor[:5], anchor.step)
        inputs, states, costs, a, b, by_state, by_input = tried
        value, slope, costates = self._expand(states, inputs, costs, arguments.data, a, b, by_state, by_input)
        judged = self._judge(inputs, states, value, slope, arguments.lower, arguments.upper, *anchor)
        *fields, accepted = judged
        return Anchor(*fields), Expanded(inputs, states, a, b, by_state, by_input, costates, accepted)

    def directed(self, anchor: Anchor, plan: Expanded, arguments: Arguments) -> Anchor:
        """The anchor with the sweep's direction, renewed where the last plan was accepted."""
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


def _direction(ocp: OptimalControl, hessian: HessianModel, map: Deformation, damping: float) -> ca.Function:
    """Function (U, X, A, B, l_s, l_u, costates, data, lower, upper) -> (v, K): the deformed feedforward and its feedback."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    inputs, states = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1)
    stacked = [ca.MX.sym(f"m{k}", rows, columns * n) for k, (rows, columns) in enumerate(_stage_shapes(ns, nu))]
    costates, data = ca.MX.sym("lambda", ns, n), ca.MX.sym("data", ocp.data.size, n + 1)
    lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
    hessians = hessian_stage(ocp, hessian).map(n)(states[:, :n], inputs, data[:, :n], costates)
    _, slope, value = hessian_end(ocp)(states[:, n], data[:, n])
    bounds = ca.repmat(lower, 1, n), ca.repmat(upper, 1, n)
    move, gains = backward_sweep(ocp, damping)(*stacked, *hessians, inputs, *bounds, value, slope)
    results = [ca.reshape(deformed_move(map, nu * n)(ca.vec(move)), nu, n), gains]
    return ca.Function("fpirhc_direction", [inputs, states, *stacked, costates, data, lower, upper], results)


def deformed_move(map: Deformation, size: int) -> ca.Function:
    """Function v -> G(0, -v, 0): the feedforward -h as the map makes it."""
    column = ca.SX.sym("v", size)
    deformed, _ = map.step(ca.SX.zeros(size), -column, ca.SX.zeros(size), {})
    return ca.Function("fpirhc_deformed_move", [column], [ca.densify(deformed)])


def _judgement(ocp: OptimalControl) -> ca.Function:
    """Function (U, X, V, g of the plan tried, lower, upper, anchor) -> (anchor, accepted)."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    inputs, states = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1)
    value, slope = ca.MX.sym("V"), ca.MX.sym("g", nu, n)
    lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
    shapes = [(nu, n), (ns, n), (nu, n), (nu, ns * n), (nu, n), (nu, n), (1, 1), (1, 1), (1, 1), (1, 1), (1, 1)]
    old = Anchor(*(ca.MX.sym(name, *shape) for name, shape in zip(Anchor._fields, shapes, strict=True)))
    scale = ca.repmat(ca.DM(1 / (ocp.step * ocp.curvature)), 1, n)

    def plain_step(u: ca.MX, g: ca.MX, gamma: ca.MX) -> ca.MX:
        return clip(u - gamma * scale * g, lower, upper)

    def size(difference: ca.MX) -> ca.MX:
        return ca.dot(difference, difference / scale)

    plain = plain_step(inputs, slope, old.gamma)
    envelope = value + ca.dot(slope, plain - inputs) + size(plain - inputs) / (2 * old.gamma)
    untried, bold = old.value >= UNTRIED, old.step >= SHORTEST
    reach = size(old.plain - old.inputs) / (2 * old.gamma)
    slack = ROUNDING * (1 + ca.fabs(old.value))
    enough = envelope <= old.envelope - SHARE * (1 - SHARE) * reach + slack
    # A step that a saturating map or the search made short decreases by its own measure, not by that of T.
    fair = value <= old.value + ARMIJO * ca.fmin(ca.dot(old.slope, inputs - old.inputs), 0) + slack
    # Far away gamma may be too long for the envelope to bound V from below, so V itself must not rise; it does not at T.
    falls = ca.logic_and(envelope <= old.envelope + slack, value <= old.value + slack)
    decreases = ca.logic_and(falls, ca.logic_or(enough, fair))
    promised = old.value + ca.dot(old.slope, old.plain - old.inputs)
    bounded = value <= promised + SHARE * reach + slack
    finite = is_finite(ca.vertcat(value, ca.vec(slope), ca.vec(states)))
    accepted = ca.logic_and(finite, ca.logic_or(untried, ca.if_else(bold, decreases, bounded)))
    # A rejected T means that gamma was too long; a rejected warm start, that a plan without memory is next.
    # The quadratic that the cost followed along T - U says which gamma would have been short enough.
    rise = ca.if_else(finite, (value - promised) / (SHARE * reach + TINY), 0)
    drawn_in = ca.if_else(rise > 2, ca.fmax(1 / ca.fmax(rise, 1), DRAWN_IN), 0.5)
    shorter = ca.if_else(ca.logic_or(untried, bold), old.gamma, drawn_in * old.gamma)
    retreat = old._replace(
        gamma=shorter,
        step=ca.if_else(untried, SHORTEST * SHORTER, SHORTER * old.step),
        plain=ca.if_else(untried, old.plain, plain_step(old.inputs, old.slope, shorter)),
    )
    shrunk = size(retreat.plain - old.inputs) / (2 * shorter)
    retreat = retreat._replace(
        envelope=ca.if_else(untried, old.envelope, old.value + ca.dot(old.slope, retreat.plain - old.inputs) + shrunk)
    )
    step = ca.if_else(untried, old.resume, 1)
    advance = Anchor(
        inputs, states[:, :n], old.move, old.gains, plain, slope, value, envelope, step, old.gamma, old.resume
    )
    next_anchor = [ca.if_else(accepted, new, back) for new, back in zip(advance, retreat, strict=True)]
    return ca.Function("fpirhc_judgement", [inputs, states, value, slope, lower, upper, *old], [*next_anchor, accepted])


def _stage_shapes(ns: int, nu: int) -> tuple[tuple[int, int], ...]:
    return (ns, ns), (ns, nu), (ns, 1), (nu, 1)


def _turned(stacked: ca.MX, stages: int) -> ca.MX:
    """The blocks of the stages in reverse order."""
    return ca.horzcat(*reversed(ca.horzsplit(stacked, stacked.shape[1] // stages))) if stages > 1 else stacked
