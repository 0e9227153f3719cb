"""The two measures of an interior plan: infeasibility theta and barrier function phi.

    theta = sum |gaps| / unit + sum |d - t + e| / unit,
    phi   = V + sum (rho e - mu log e) over limits of states - mu sum log t,

with d the distances of the plan from its limits, t their slacks and e their elastics.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.bounds import Interior
from fpirhc.optimisers.limited_turn.call import Call
from fpirhc.optimisers.limited_turn.state import State


def trial(call: Call, s: State, p: Expansion) -> Interior:
    """Return slacks, elastics and multipliers after the step to p; the multipliers stay near mu / t."""
    stepped = s["t"] + s["alpha"] * s["dt"], s["e"] + s["alpha"] * s["de"]
    t, e = (ca.if_else(s["descends"], a, b) for a, b in zip(call.limits.path(p, s["mu"]), stepped, strict=True))
    z = s["z"] + s["alpha_dual"] * s["dz"]
    safe = ca.if_else(call.limits.present, t, 1)
    near = ca.fmin(ca.fmax(z, s["mu"] / (1e8 * safe)), 1e8 * s["mu"] / safe)
    return Interior(t, e, ca.if_else(call.limits.present, near, 0))


def merit(call: Call, p: Expansion, y: Interior, mu: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return (theta, phi)."""
    limits, gaps = call.limits, (p.next_states - p.states[:, 1:]) / call.spread
    apart = ca.if_else(limits.present, ca.fabs(limits.distance(p) - y.t + y.e) / limits.unit, 0)
    states = ca.logic_and(limits.present, limits.of_states)
    price = ca.if_else(states, limits.rho * y.e - mu * ca.log(ca.if_else(states, y.e, 1)), 0)
    barrier = price - mu * ca.log(ca.if_else(limits.present, y.t, 1))
    return ca.sum1(ca.vec(ca.fabs(gaps))) + ca.sum1(ca.vec(apart)), p.value + ca.sum1(ca.vec(barrier))


def merit_slope(call: Call, s: State, p: Expansion) -> ca.MX:
    """Return the derivative of phi along the step."""
    limits, n = call.limits, call.ocp.stages
    total = ca.dot(p.by_input, s["du"]) + ca.dot(p.by_state, s["dx"][:, :n]) + ca.dot(p.tail, s["dx"][:, n])
    states = ca.logic_and(limits.present, limits.of_states)
    price = ca.if_else(states, (limits.rho - s["mu"] / ca.if_else(states, s["e"], 1)) * s["de"], 0)
    slacks = ca.if_else(limits.present, s["mu"] * s["dt"] / ca.if_else(limits.present, s["t"], 1), 0)
    return total + ca.sum1(ca.vec(price - slacks))
