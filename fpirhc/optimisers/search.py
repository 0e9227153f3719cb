"""The line search of `FixedPointSolver` as a graph: one plan per iteration is tried, and the best one so far is the anchor.

The search is built from Functions of a whole horizon, so that an iteration adds calls to the graph, and no copies. A Riccati
sweep solves the horizon's quadratic model stage by stage, within the input bounds.
Sources: D. Q. Mayne, Int. J. Control 3(1), 1966; Y. Tassa, N. Mansard, E. Todorov, IEEE ICRA 2014, for the box of the inputs.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import casadi as ca
import numpy as np

from fpirhc.deformation.base import Deformation
from fpirhc.horizon.hessian_models import HessianModel, hessian_end, hessian_stage, linear_stage
from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers import clip, sane
from fpirhc.symbolic.expression import FINITE, TINY, is_finite, kind

SHARE = 0.95  # gamma L, and the share of the guaranteed decrease that is required
ARMIJO = 1e-2  # share of the first-order decrease that is required of a short step
SHORTER = 0.25  # factor of the step after a plan that did not decrease the envelope
FLAT = 1e-9  # of the cost: a sweep that promises less finds nothing to lower
DRAWN_IN = 0.01  # least factor of gamma after a plain step that was rejected
SHORTEST = 0.05  # below it the plain fixed-point step is taken
ROUNDING = 1e-13  # relative to the cost: smaller differences are rounding
UNTRIED = FINITE / 16  # a cost from which on an anchor counts as not evaluated
_SCALAR_CODE = 1000  # multiplications of one stage up to which scalar code is faster than matrix calls
BOX_PIVOT = 1e-12  # relative size below which a pivot is replaced: the direction then still descends


class Arguments(NamedTuple):
    """The arguments of one call."""

    s0: ca.MX
    data: ca.MX
    lower: ca.MX
    upper: ca.MX


class Anchor(NamedTuple):
    """The best plan so far, the next step from it, and the step's length."""

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
    resume: ca.MX  # tau after the evaluation of a remembered plan
    sent: ca.MX  # the largest move that a sweep at U wants of an input; beyond every number before one
    curved: ca.MX  # Q_uu of the last sweep (nu, nu N); zero before one


class _Expanded(NamedTuple):
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
    """Return a gamma that is short enough near the reference: SHARE / L in the metric of D."""
    return SHARE / ocp.steepest


class Search:
    """Builds the expressions of the iteration."""

    def __init__(self, ocp: OptimalControl, hessian: HessianModel, map: Deformation, damping: float) -> None:
        self._expand, self._try = _expansion(ocp), _trial(ocp)
        self._judge = _judgement(ocp)
        self._direct = _direction(ocp, hessian, map, damping)
        self._look = _look(ocp)

    def tried(self, anchor: Anchor, arguments: Arguments) -> tuple[Anchor, _Expanded]:
        """Return the anchor after its next plan was tried, and that plan expanded."""
        tried = self._try(arguments.s0, arguments.data, arguments.lower, arguments.upper, *anchor[:5], anchor.step)
        inputs, states, costs, a, b, by_state, by_input = tried
        value, slope, costates = self._expand(states, inputs, costs, arguments.data, a, b, by_state, by_input)
        value = ca.if_else(sane(*arguments), value, ca.inf)  # where nothing is posed no plan is accepted
        judged = self._judge(inputs, states, value, slope, arguments.lower, arguments.upper, *anchor)
        *fields, accepted = judged
        return Anchor(*fields), _Expanded(inputs, states, a, b, by_state, by_input, costates, accepted)

    def directed(self, anchor: Anchor, plan: _Expanded, arguments: Arguments) -> Anchor:
        """Return the anchor with the direction of a sweep where the last plan was accepted, else with its old direction."""
        move, gains, curved, *seen = self._direct(*plan[:7], arguments.data, arguments.lower, arguments.upper)
        made = {"move": move, "gains": gains, "curved": curved, "sent": _wanted(anchor, *seen)}
        return anchor._replace(**{k: ca.if_else(plan.accepted, new, getattr(anchor, k)) for k, new in made.items()})

    def looked(self, anchor: Anchor, plan: _Expanded, arguments: Arguments) -> Anchor:
        """Return the anchor with what a sweep at a plan that was accepted would want, by the factors of the last sweep."""
        given = plan.inputs, plan.states, *plan[2:6], anchor.gains, anchor.curved
        sent = _wanted(anchor, *self._look(*given, arguments.data, arguments.lower, arguments.upper))
        swept = ca.norm_inf(ca.vec(anchor.curved)) > 0
        return anchor._replace(sent=ca.if_else(ca.logic_and(plan.accepted, swept), sent, anchor.sent))


def _wanted(anchor: Anchor, most: ca.MX, fall: ca.MX) -> ca.MX:
    """The largest move that a sweep wants: none where the cost is flat, because a move there lowers the cost by nothing."""
    flat = FLAT * ca.fabs(anchor.value)
    # What is no number is no certificate.
    return ca.if_else(fall > flat, most, ca.if_else(fall <= flat, 0, FINITE))


def _trial(ocp: OptimalControl) -> ca.Function:
    """Function (s0, data, lower, upper, U, X, v, K, T, tau) -> (U, X (ns, N + 1), costs, A, B, l_s, l_u) of the next plan."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    s, _, theta = ocp.dynamics.sx_in()
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
    turned = [in_reverse(m, n) for m in stacked]
    _, slope, costates = stage.mapaccum("fpirhc_costate_stages", n)(last, *turned)
    results = [ca.sum2(costs) + final, in_reverse(slope, n), in_reverse(costates, n)]
    return ca.Function("fpirhc_expansion", [states, inputs, costs, data, *stacked], results)


def _direction(ocp: OptimalControl, hessian: HessianModel, map: Deformation, damping: float) -> ca.Function:
    """Function (U, X, A, B, l_s, l_u, costates, data, lower, upper) -> (v deformed, K, Q_uu, largest move, promised fall)."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    inputs, states = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1)
    stacked = [ca.MX.sym(f"m{k}", rows, columns * n) for k, (rows, columns) in enumerate(_stage_shapes(ns, nu))]
    costates, data = ca.MX.sym("lambda", ns, n), ca.MX.sym("data", ocp.data.size, n + 1)
    lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
    hessians = hessian_stage(ocp, hessian).map(n)(states[:, :n], inputs, data[:, :n], costates)
    _, slope, value = hessian_end(ocp)(states[:, n], data[:, n])
    bounds = ca.repmat(lower, 1, n), ca.repmat(upper, 1, n)
    move, gains, curved, fall = backward_sweep(ocp, damping)(*stacked, *hessians, inputs, *bounds, value, slope)
    deformed = deformed_move(map, nu * n)(ca.vec(move))
    results = [ca.reshape(deformed, nu, n), gains, curved, ca.norm_inf(ca.vec(move)), fall]
    return ca.Function("fpirhc_direction", [inputs, states, *stacked, costates, data, lower, upper], results)


def _look(ocp: OptimalControl) -> ca.Function:
    """Function (U, X, A, B, l_s, l_u, K, Q_uu, data, lower, upper) -> (largest move, promised fall), by one adjoint pass."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    shapes = [(ns, 1), *_stage_shapes(ns, nu), (nu, ns), (nu, nu), (nu, 1), (nu, 1), (nu, 1)]
    ahead, a, b, by_state, by_input, gain, curved, u, low, high = y = [
        ca.SX.sym(f"y{k}", *shape) for k, shape in enumerate(shapes)
    ]
    steep = by_input + b.T @ ahead
    move, _ = box_policy(nu, 1)(steep, curved, ca.SX.zeros(nu, 1), low - u, high - u)
    results = [by_state + a.T @ ahead + gain.T @ steep, ca.norm_inf(move), -0.5 * ca.dot(steep, move)]
    stage = ca.Function("fpirhc_look_stage", y, results)
    inputs, states = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1)
    stacked = [ca.MX.sym(f"m{k}", rows, columns * n) for k, (rows, columns) in enumerate(shapes[1:7])]
    data, lower, upper = ca.MX.sym("data", ocp.data.size, n + 1), ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
    _, slope, _ = hessian_end(ocp)(states[:, n], data[:, n])
    turned = [in_reverse(m, n) for m in (*stacked, inputs)]
    _, moves, falls = stage.mapaccum("fpirhc_look_stages", n)(
        slope, *turned, *(ca.repmat(v, 1, n) for v in (lower, upper))
    )
    return ca.Function("fpirhc_look", [inputs, states, *stacked, data, lower, upper], [ca.mmax(moves), ca.sum2(falls)])


def deformed_move(map: Deformation, size: int) -> ca.Function:
    """Function v -> G(0, -v, 0): the deformed feedforward."""
    column = ca.SX.sym("v", size)
    deformed, _ = map.step(ca.SX.zeros(size), -column, ca.SX.zeros(size), {})
    return ca.Function("fpirhc_deformed_move", [column], [ca.densify(deformed)])


def _stage_shapes(ns: int, nu: int) -> tuple[tuple[int, int], ...]:
    return (ns, ns), (ns, nu), (ns, 1), (nu, 1)


def _judgement(ocp: OptimalControl) -> ca.Function:
    """Function (U, X, V, g of the plan tried, lower, upper, anchor) -> (anchor, accepted)."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    inputs, states = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1)
    value, slope = ca.MX.sym("V"), ca.MX.sym("g", nu, n)
    lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
    shapes = [(nu, n), (ns, n), (nu, n), (nu, ns * n), (nu, n), (nu, n), *[(1, 1)] * 6, (nu, nu * n)]
    old = Anchor(*(ca.MX.sym(name, *shape) for name, shape in zip(Anchor._fields, shapes, strict=True)))
    scale = cast(ca.MX, ca.repmat(ca.DM(ocp.scale), 1, n))
    # Flags: whether the anchor was never evaluated, and whether the plan is a step along the sweep's direction.
    metric, flags = _Metric(scale, lower, upper), (old.value >= UNTRIED, old.step >= SHORTEST)
    plain = metric.plain_step(inputs, slope, old.gamma)
    envelope = value + ca.dot(slope, plain - inputs) + metric.size(plain - inputs) / (2 * old.gamma)
    finite = is_finite(ca.vertcat(value, ca.vec(slope), ca.vec(states)))
    accepted, excess = _accepted(metric, old, (inputs, value, envelope), finite, flags)
    retreat = _retreat(metric, old, finite, excess, flags)
    step = ca.if_else(flags[0], old.resume, 1)
    here = {"inputs": inputs, "states": states[:, :n], "plain": plain, "slope": slope, "value": value}
    advance = old._replace(**here, envelope=envelope, step=step, sent=ca.MX(FINITE))
    next_anchor = [ca.if_else(accepted, new, back) for new, back in zip(advance, retreat, strict=True)]
    arguments = [inputs, states, value, slope, lower, upper, *old]
    return ca.Function("fpirhc_judgement", arguments, [*next_anchor, accepted])


class _Metric:
    """The plain step T = clip(U - gamma D g) and the norm |d|^2 = d' D^-1 d of one call."""

    def __init__(self, scale: ca.MX, lower: ca.MX, upper: ca.MX) -> None:
        self._scale = scale
        self._lower, self._upper = lower, upper

    def plain_step(self, u: ca.MX, g: ca.MX, gamma: ca.MX) -> ca.MX:
        return clip(u - gamma * self._scale * g, self._lower, self._upper)

    def size(self, difference: ca.MX) -> ca.MX:
        return ca.dot(difference, difference / self._scale)


def _accepted(
    metric: _Metric, old: Anchor, tried: tuple[ca.MX, ca.MX, ca.MX], finite: ca.MX, flags: tuple[ca.MX, ca.MX]
) -> tuple[ca.MX, ca.MX]:
    """Whether the plan is accepted, and the excess of V over its linear model, relative to the quadratic term of gamma."""
    (inputs, value, envelope), (untried, bold) = tried, flags
    reach = metric.size(old.plain - old.inputs) / (2 * old.gamma)
    slack = ROUNDING * (1 + ca.fabs(old.value))
    enough = envelope <= old.envelope - SHARE * (1 - SHARE) * reach + slack
    # A step that a saturating map or the search made short decreases by its own measure, not by that of T.
    fair = value <= old.value + ARMIJO * ca.fmin(ca.dot(old.slope, inputs - old.inputs), 0) + slack
    # Far away gamma may be too long for the envelope to bound V from below, so V itself must not rise; it does not at T.
    falls = ca.logic_and(envelope <= old.envelope + slack, value <= old.value + slack)
    decreases = ca.logic_and(falls, ca.logic_or(enough, fair))
    promised = old.value + ca.dot(old.slope, old.plain - old.inputs)
    bounded = value <= promised + SHARE * reach + slack
    accepted = ca.logic_and(finite, ca.logic_or(untried, ca.if_else(bold, decreases, bounded)))
    return accepted, (value - promised) / (SHARE * reach + TINY)


def _retreat(metric: _Metric, old: Anchor, finite: ca.MX, excess: ca.MX, flags: tuple[ca.MX, ca.MX]) -> Anchor:
    """The anchor after a rejected plan.

    A rejected T means that gamma was too long. After a rejected warm start a plan without memory is next. The quadratic term
    that V showed along T - U gives a gamma that would have been short enough.
    """
    untried, bold = flags
    rise = ca.if_else(finite, excess, 0)
    drawn_in = ca.if_else(rise > 2, ca.fmax(1 / ca.fmax(rise, 1), DRAWN_IN), 0.5)
    shorter = ca.if_else(ca.logic_or(untried, bold), old.gamma, drawn_in * old.gamma)
    retreat = old._replace(
        gamma=shorter,
        step=ca.if_else(untried, SHORTEST * SHORTER, SHORTER * old.step),
        plain=ca.if_else(untried, old.plain, metric.plain_step(old.inputs, old.slope, shorter)),
    )
    shrunk = metric.size(retreat.plain - old.inputs) / (2 * shorter)
    envelope = old.value + ca.dot(old.slope, retreat.plain - old.inputs) + shrunk
    return retreat._replace(envelope=ca.if_else(untried, old.envelope, envelope))


def rounds(inputs: int) -> int:
    """Largest number of active-set changes of a stage's box QP."""
    return 2 * inputs if inputs > 1 else 1


def backward_sweep(ocp: OptimalControl, damping: float) -> ca.Function:
    """Function (stage columns, P_N, p_N) -> (v (nu, N), K (nu, ns N), Q_uu (nu, nu N), fall).

    v is in [lower - u, upper - u], and fall is what the sweep promises to lower the cost by.

    With the cost to go of stage i+1 modelled by 1/2 dx'P dx + p'dx, stage i minimises Q_u' v + 1/2 v' Q_uu v with

        Q_u = l_u + B'p,   Q_uu = R + B'P B + mu D^-1,   Q_us = S + B'P A.

    Inputs that end at a bound get no feedback; the others get K = -Q_uu^-1 Q_us on the free set. Then P <- Q + A'PA + Q_us'K and
    p <- Q_s + Q_us'v + K'(Q_u + Q_uu v). Without active bounds v, rolled out through the linear model with K, is -M^-1 g with M the
    Hessian of the quadratic model: a preconditioner that couples all stages, at the cost of N small factorisations.

    The stage columns, each stacked over the stages, are A, B, l_s, l_u, Q, S, R, U, lower, upper.
    """
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    shapes = {"A": ns, "B": nu, "ls": 1, "lu": 1, "Q": ns, "S": ns, "R": nu, "U": 1, "lower": 1, "upper": 1}
    rows = {"A": ns, "B": ns, "ls": ns, "lu": nu, "Q": ns, "S": nu, "R": nu, "U": nu, "lower": nu, "upper": nu}
    stacked = [ca.MX.sym(name, rows[name], columns * n) for name, columns in shapes.items()]
    value, slope = ca.MX.sym("P", ns, ns), ca.MX.sym("p", ns)
    sweep = _stage(ocp, damping).mapaccum("fpirhc_riccati_stages", n, 2)
    reversed_stages = [in_reverse(column, n) for column in stacked]
    _, _, moves, gains, curved, falls = sweep(value, slope, *reversed_stages)
    results = [in_reverse(moves, n), in_reverse(gains, n), in_reverse(curved, n), ca.sum2(falls)]
    names = [*shapes, "P", "p"]
    return ca.Function("fpirhc_riccati", [*stacked, value, slope], results, names, ["v", "K", "Q_uu", "fall"])


def _stage(ocp: OptimalControl, damping: float) -> ca.Function:
    """Function (P, p, A, B, l_s, l_u, Q, S, R, u, lower, upper) -> (P, p, v, K, Q_uu, fall)."""
    ns, nu = ocp.state.size, ocp.input.size
    sym = kind(opaque=ns * ns * (ns + nu) > _SCALAR_CODE).sym
    value, slope = sym("P", ns, ns), sym("p", ns)
    a, b, by_state, by_input = sym("A", ns, ns), sym("B", ns, nu), sym("ls", ns), sym("lu", nu)
    q, s, r = sym("Q", ns, ns), sym("S", nu, ns), sym("R", nu, nu)
    u, lower, upper = sym("u", nu), sym("lower", nu), sym("upper", nu)
    added = ca.DM(np.diag(ca.DM(damping / ocp.scale).full().ravel()))  # of an open number CasADi makes no DM
    value_a = ca.mtimes(value, a)
    damped = r + ca.mtimes(b.T, ca.mtimes(value, b)) + added
    coupled = s + ca.mtimes(b.T, value_a)
    input_slope = by_input + ca.mtimes(b.T, slope)
    move, gain = box_policy(nu, ns)(input_slope, damped, coupled, lower - u, upper - u)
    next_value = q + ca.mtimes(a.T, value_a) + ca.mtimes(coupled.T, gain)
    next_slope = by_state + ca.mtimes(a.T, slope) + ca.mtimes(coupled.T, move)
    next_slope += ca.mtimes(gain.T, input_slope + ca.mtimes(damped, move))
    fall = -0.5 * ca.dot(input_slope, move)
    arguments = [value, slope, a, b, by_state, by_input, q, s, r, u, lower, upper]
    results = [0.5 * (next_value + next_value.T), next_slope, move, gain, damped, fall]
    return ca.Function("fpirhc_riccati_stage", arguments, results)


def box_policy(nu: int, ns: int) -> ca.Function:
    """Function (Q_u, Q_uu, Q_us, low, high) -> (v, K): the stage's box QP by projected Newton steps, and its feedback.

    The best move of all rounds is the result, so it is at least as good as v = 0. It is v = 0 only where the first-order conditions
    with bounds hold.
    """
    slope, hessian, coupled = ca.SX.sym("Qu", nu), ca.SX.sym("Quu", nu, nu), ca.SX.sym("Qus", nu, ns)
    low, high = ca.SX.sym("low", nu), ca.SX.sym("high", nu)
    move, best, lowest = ca.SX.zeros(nu), ca.SX.zeros(nu), ca.SX(0)
    for _ in range(rounds(nu)):
        free = _free(move, slope + hessian @ move, low, high)
        target = -(slope + hessian @ ((1 - free) * move))
        wanted = solve_free(hessian, free, target)
        move = ca.fmin(ca.fmax(free * wanted + (1 - free) * move, low), high)
        value = ca.dot(slope + 0.5 * (hessian @ move), move)
        better = value < lowest
        best, lowest = ca.if_else(better, move, best), ca.if_else(better, value, lowest)
    free = _free(best, slope + hessian @ best, low, high)
    gain = solve_free(hessian, free, -coupled)
    return ca.Function("fpirhc_box_policy", [slope, hessian, coupled, low, high], ca.cse([best, gain]))


def _free(move: ca.SX, slope: ca.SX, low: ca.SX, high: ca.SX) -> ca.SX:
    """1 where a change of the input can lower the cost, 0 where its bound prevents that."""
    at_bound = ca.logic_or(ca.logic_and(move <= low, slope > 0), ca.logic_and(move >= high, slope < 0))
    return ca.if_else(at_bound, 0, 1)


def solve_free(hessian: ca.SX, free: ca.SX, right: ca.SX) -> ca.SX:
    """Solve the free rows and columns by L D L'; rows that are not free are zero.

    A pivot that is not positive is replaced by the size of its diagonal entry, so that the result is still a descent direction.
    """
    n = free.numel()
    lower, pivots = ca.SX.eye(n), list[ca.SX]()
    for j in range(n):
        known = sum((lower[j, k] ** 2 * pivots[k] for k in range(j)), start=ca.SX(0))
        pivot = free[j] * (hessian[j, j] - known)
        size = ca.fabs(hessian[j, j]) + TINY
        pivots.append(ca.if_else(pivot > BOX_PIVOT * size, pivot, size))
        for i in range(j + 1, n):
            known = sum((lower[i, k] * lower[j, k] * pivots[k] for k in range(j)), start=ca.SX(0))
            lower[i, j] = free[i] * free[j] * (hessian[i, j] - known) / pivots[j]
    solution = ca.SX(right)
    for i in range(n):
        solution[i, :] = free[i] * right[i, :] - sum(
            (lower[i, k] * solution[k, :] for k in range(i)), start=ca.SX.zeros(1, right.shape[1])
        )
    for i in range(n):
        solution[i, :] = solution[i, :] / pivots[i]
    for i in reversed(range(n)):
        solution[i, :] = solution[i, :] - sum(
            (lower[k, i] * solution[k, :] for k in range(i + 1, n)), start=ca.SX.zeros(1, right.shape[1])
        )
    return solution


def in_reverse(stacked: ca.MX, stages: int) -> ca.MX:
    """Return the blocks of the stages in reverse order."""
    return ca.horzcat(*reversed(ca.horzsplit(stacked, stacked.shape[1] // stages))) if stages > 1 else stacked
