"""How far a plan with limits is from the first-order conditions, with multipliers of its own.

    E = max( |U - clip(U - gamma g)| / unit,  |gap| / unit,  |min(d, gamma z)| / unit,  gamma max(-z, 0) / unit ),

with g the reduced gradient with the multipliers of limited states. A limit that is given up (z = rho) need not be kept: its plan
is a stationary point of the cost plus rho times the violations, and z = rho certifies that the limits cannot all be kept nearby.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.base import clip
from fpirhc.optimisers.bounds import ENOUGH, Interior, Limited
from fpirhc.optimisers.scales import Scales
from fpirhc.symbolic.expression import FINITE, is_finite


class Certified(NamedTuple):
    """How far a plan is from the first-order conditions."""

    slope: ca.MX  # g (nu, N)
    left: ca.MX  # stationarity
    violation: ca.MX
    broken: ca.MX  # violation of limits that are not given up
    error: ca.MX  # E


def certified(ocp: OptimalControl, limits: Limited, scales: Scales, p: Expansion, z: ca.MX) -> Certified:
    """Return how far an expanded plan with multipliers z (rows, 2 N) is from the first-order conditions."""
    n = ocp.stages
    slope = certify(ocp, limits, p, z)
    units = [
        ca.repmat(ca.DM(v), 1, n) for v in (scales.inputs, scales.inputs**2 / scales.cost, ocp.step * ocp.curvature)
    ]
    low, high = limits.inputs()
    step = ca.fabs(p.inputs - clip(p.inputs - units[1] * slope, low, high)) / units[0]
    left = ca.norm_inf(ca.vec(p.inputs - clip(p.inputs - slope / units[2], low, high)))
    d = limits.distance(p)
    counted = ca.logic_and(limits.present, limits.of_states)
    given_up = z >= ENOUGH * limits.rho
    complementarity = ca.fabs(ca.fmin(d, limits.reach * ca.fmin(ca.fmax(z, 0), limits.rho)))
    error = ca.if_else(given_up, ca.fmax(d, 0), complementarity)
    error = ca.if_else(counted, ca.fmax(error, limits.reach * ca.fmax(-z, 0)) / limits.unit, 0)
    beyond = ca.if_else(counted, ca.fmax(-d, 0), 0)
    broken = ca.if_else(given_up, 0, beyond)
    worst = ca.fmax(ca.fmax(ca.mmax(step), largest_gap(p, scales)), ca.mmax(error))
    finite = is_finite(ca.vec(slope))
    numbers = [ca.if_else(finite, v, 10 * FINITE) for v in (left, worst)]
    return Certified(slope, numbers[0], ca.mmax(beyond * limits.hard), ca.mmax(broken), numbers[1])


def certify(ocp: OptimalControl, limits: Limited, p: Expansion, z: ca.MX, counted: ca.MX | float = 1) -> ca.MX:
    """Return the reduced gradient g (nu, N) with the multipliers of states that are `counted`."""
    return adjoint(ocp, limits, p, limits.pushes(z, counted))


def adjoint(ocp: OptimalControl, limits: Limited, p: Expansion, push: ca.MX) -> ca.MX:
    """Return g (nu, N) by one backward sweep; `push` (rows, N) are gradients with respect to the limited entries."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    shapes = ((ns, 1), (ns, ns), (ns, nu), (ns, 1), (nu, 1), (ns, 1))
    costate, a, b, by_state, by_input, more = y = [ca.SX.sym(f"y{k}", *shape) for k, shape in enumerate(shapes)]
    after = costate + more
    stage = ca.Function("fpirhc_certified_stage", y, [by_state + a.T @ after, by_input + b.T @ after])
    pushed = limits.on_states(push)
    turned = [_turned(v, n) for v in (p.a, p.b, p.by_state, p.by_input, pushed)]
    return _turned(stage.mapaccum("fpirhc_certified_stages", n)(p.tail, *turned)[1], n)


def largest_gap(p: Expansion, scales: Scales) -> ca.MX:
    """Return the largest |F(X, U) - X+| in units of the states."""
    gaps = ca.fabs(p.next_states - p.states[:, 1:])
    return ca.mmax(gaps / ca.repmat(ca.DM(scales.states), 1, gaps.shape[1]))


def barrier_error(
    limits: Limited, scales: Scales, p: Expansion, y: Interior, costates: ca.MX
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Return the scaled residual of the barrier problem without complementarity, and the least and largest of its products."""
    n = p.inputs.shape[1]
    states, z = ca.logic_and(limits.present, limits.of_states), y.z
    push = limits.both(-limits.sign * z)
    apart = ca.if_else(limits.present, ca.fabs(limits.distance(p) - y.t + y.e) / limits.unit, 0)
    pairs = [(limits.present, y.t * z), (states, y.e * (limits.rho - z))]
    least = ca.fmin(*(ca.mmin(ca.if_else(c, v, 10 * FINITE)) for c, v in pairs))
    most = ca.fmax(*(ca.mmax(ca.if_else(c, v, 0)) for c, v in pairs))
    nu, ns = p.inputs.shape[0], p.next_states.shape[0]
    rest_u = p.by_input + push[:nu, :] + _stage_product(p.b, costates, nu, ns, n)
    before = ca.horzcat(p.by_state[:, 1:] + _stage_product(p.a, costates, ns, ns, n)[:, 1:], p.tail)
    rest_x = before - costates + limits.on_states(push)
    units = [ca.repmat(ca.DM(v), 1, n) / scales.cost for v in (scales.inputs, scales.states)]
    worst = [ca.mmax(ca.fabs(r) * u) for r, u in zip((rest_u, rest_x), units, strict=True)]
    total = ca.fmax(ca.fmax(*worst), ca.fmax(largest_gap(p, scales), ca.mmax(apart)))
    return total, least, most


def _stage_product(stacked: ca.MX, costates: ca.MX, columns: int, rows: int, n: int) -> ca.MX:
    """A_i' lambda_{i+1} for every stage, (columns, N)."""
    a, costate = ca.SX.sym("a", rows, columns), ca.SX.sym("l", rows)
    return ca.Function("fpirhc_stage_product", [a, costate], [a.T @ costate]).map(n)(stacked, costates)


def _turned(stacked: ca.MX, stages: int) -> ca.MX:
    return ca.horzcat(*reversed(ca.horzsplit(stacked, stacked.shape[1] // stages))) if stages > 1 else stacked
