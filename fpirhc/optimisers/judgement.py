"""Whether the line search of `FixedPoint` accepts a plan, and the anchor afterwards."""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.anchor import ARMIJO, DRAWN_IN, ROUNDING, SHARE, SHORTER, SHORTEST, UNTRIED, Anchor
from fpirhc.optimisers.base import clip
from fpirhc.symbolic.expression import is_finite

_TINY = 1e-300


def judgement(ocp: OptimalControl) -> ca.Function:
    """Function (U, X, V, g of the plan tried, lower, upper, anchor, [scale]) -> (anchor, accepted)."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    inputs, states = ca.MX.sym("U", nu, n), ca.MX.sym("X", ns, n + 1)
    value, slope = ca.MX.sym("V"), ca.MX.sym("g", nu, n)
    lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
    shapes = [(nu, n), (ns, n), (nu, n), (nu, ns * n), (nu, n), (nu, n), (1, 1), (1, 1), (1, 1), (1, 1), (1, 1)]
    old = Anchor(*(ca.MX.sym(name, *shape) for name, shape in zip(Anchor._fields, shapes, strict=True)))
    live = [ca.MX.sym("scale", nu)] if ocp.settings else []
    scale = ca.repmat(live[0] if live else ocp.scale_in(None), 1, n)
    # Flags: whether the anchor was never evaluated, and whether the plan is a step along the sweep's direction.
    metric, flags = _Metric(scale, lower, upper), (old.value >= UNTRIED, old.step >= SHORTEST)
    plain = metric.plain_step(inputs, slope, old.gamma)
    envelope = value + ca.dot(slope, plain - inputs) + metric.size(plain - inputs) / (2 * old.gamma)
    finite = is_finite(ca.vertcat(value, ca.vec(slope), ca.vec(states)))
    accepted, excess = _accepted(metric, old, (inputs, value, envelope), finite, flags)
    retreat = _retreat(metric, old, finite, excess, flags)
    step = ca.if_else(flags[0], old.resume, 1)
    advance = Anchor(
        inputs, states[:, :n], old.move, old.gains, plain, slope, value, envelope, step, old.gamma, old.resume
    )
    next_anchor = [ca.if_else(accepted, new, back) for new, back in zip(advance, retreat, strict=True)]
    arguments = [inputs, states, value, slope, lower, upper, *old, *live]
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
    return accepted, (value - promised) / (SHARE * reach + _TINY)


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
