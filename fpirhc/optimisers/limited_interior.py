"""Judges a plan of an interior step by the filter, and sets the barrier and the damping of the next one.

The filter holds pairs of infeasibility theta and barrier function phi. Where it has given up from every first plan, descents
follow (docs/theory-optimisers.md): rollouts that carry a share of the gaps and lower psi = phi + price sum |gaps| / unit.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.bounds import HAIR, Interior
from fpirhc.optimisers.certified import barrier_error
from fpirhc.optimisers.limited_settings import (
    ABOVE,
    FILTER,
    LEAST_DAMPING,
    MOST_RAISES,
    MOST_REWARMS,
    MU_MOST,
    MU_ROUNDS,
    NEARLY,
    POOR,
)
from fpirhc.optimisers.limited_state import (
    BEGINS,
    ENDS,
    INTERIOR,
    WARM,
    Call,
    State,
    as_point,
    choose,
    enter_pure,
    fixed,
    point,
    restart,
)
from fpirhc.symbolic.expression import FINITE


def judge_interior(call: Call, s: State, p: Expansion, usable: ca.MX) -> State:
    """Return the state with the plan accepted, or with a shorter or more damped step."""
    y = _trial(call, s, p)
    theta, phi = merit(call, p, y, s["mu"])
    phi += ca.if_else(s["descends"], s["price"] * _sum_of_gaps(call, p), 0)
    finite = ca.logic_and(ca.fabs(phi) <= FINITE, ca.fabs(theta) <= FINITE)
    passes, filtered = _passes_filter(call, s, theta, phi)
    passes = ca.if_else(s["descends"], _falls_enough(s, phi, call.scales.cost), passes)
    ok = ca.logic_and(ca.logic_and(usable, finite), passes)
    taken = {**s, **filtered, **as_point(p), "t": y.t, "e": y.e, "z": y.z}
    taken["costates"] = s["costates"] + s["alpha"] * (s["swept"] - s["costates"])
    taken = _advanced(call, taken)
    # The filter stays as it became where the plan is rejected for another reason, as in the loops in C.
    failed = {**s, **choose(s, ca.logic_and(usable, finite), {**s, **filtered}, s)}
    return choose(s, ok, {**taken, **fixed(accepted=1)}, {**_shortened(call, failed), **fixed(accepted=0)})


def _advanced(call: Call, s: State) -> State:
    """After an accepted plan: a new mu, and pure steps where they may end the phase."""
    y = Interior(s["t"], s["e"], s["z"])
    rest, least, most = barrier_error(call.limits, call.scales, point(s), y, s["costates"])
    cost, delta = call.scales.cost, _eased_damping(s)
    s = {**s, "delta": delta, **fixed(halvings=0, raises=0)}
    higher = {
        **s,
        "mu": ca.fmin(10 * s["mu"], MU_MOST * cost),
        "rewarms": s["rewarms"] + 1,
        **fixed(slacks=WARM, filtered=0),
    }
    mu, filtered = _lowered_barrier(call, s, rest, (least, most))
    lower = {**s, "mu": mu, "filtered": filtered}
    close = ca.fmax(rest, most / cost) <= 0.3 * ca.sqrt(s["floor"] / cost)
    lower = choose(lower, ca.logic_and(mu <= s["floor"], close), enter_pure(call, lower, ENDS), lower)
    return choose(s, _is_hardly_left(call, s), higher, lower)


def _is_hardly_left(call: Call, s: State) -> ca.MX:
    """Whether the step from a remembered plan was so short that the plan is too near its limits for its barrier."""
    remembered = ca.logic_and(s["start"] < 0, s["place_of"] == BEGINS)
    raisable = ca.logic_and(s["rewarms"] < MOST_REWARMS, s["mu"] < MU_MOST * call.scales.cost)
    return ca.logic_and(ca.logic_and(remembered, raisable), s["alpha"] < POOR)


def _eased_damping(s: State) -> ca.MX:
    """The damping after an accepted plan: less after a whole step, more after a step that was halved often."""
    halvings, delta = s["halvings"], s["delta"]
    eased = ca.if_else(delta > 5e-7, delta / 5, 0)
    eased = ca.if_else(halvings >= 3, ca.fmax(4 * delta, 1e-4), ca.if_else(halvings > 0, delta, eased))
    return ca.if_else(s["descends"], ca.fmax(eased, LEAST_DAMPING), eased)


def _lowered_barrier(call: Call, s: State, rest: ca.MX, products: tuple[ca.MX, ca.MX]) -> tuple[ca.MX, ca.MX]:
    """Lower mu as long as its barrier problem is solved; the filter is emptied with every reduction.

    Args:
        call: the problem and its arguments.
        s: the state.
        rest: scaled residual without complementarity.
        products: the least and the largest product of the complementarity.
    """
    (least, most), cost = products, call.scales.cost
    mu, filtered, going = s["mu"], s["filtered"], ca.MX(1)
    for _ in range(MU_ROUNDS):
        apart = ca.if_else(least < FINITE, mu - least, 0)
        worst = ca.fmax(rest, ca.fmax(most - mu, apart) / cost)
        going = ca.logic_and(going, ca.logic_not(ca.logic_or(worst > 10 * mu / cost, mu <= s["floor"])))
        lower = ca.fmax(s["floor"], ca.fmin(0.2 * mu, mu * ca.sqrt(mu / cost)))
        mu, filtered = ca.if_else(going, lower, mu), ca.if_else(going, 0, filtered)
    return mu, filtered


def _shortened(call: Call, s: State) -> State:
    """After a rejected plan: a shorter step, then more damping, then another first guess."""
    halved = {**s, "halvings": s["halvings"] + 1, "alpha": 0.5 * s["alpha"]}
    more = {"delta": ca.fmax(10 * s["delta"], 1e-3), "raises": s["raises"] + 1}
    raised = {**s, **fixed(halvings=0, filtered=0), **more}
    # The barrier of a remembered plan has been raised before: a first guess is cheaper than damping.
    gives_up = ca.logic_or(ca.logic_or(s["start"] < 0, raised["raises"] > MOST_RAISES), raised["delta"] > 1e8)
    again = {**raised, **fixed(again=1), "use_exact": ca.if_else(s["descends"], 0, s["use_exact"])}
    raised = choose(s, gives_up, restart(call, raised), again)
    return choose(s, s["halvings"] + 1 <= 8, halved, raised)


def _passes_filter(call: Call, s: State, theta: ca.MX, phi: ca.MX) -> tuple[ca.MX, State]:
    """Return whether the filter accepts a plan, and the filter afterwards.

    Sources: R. Fletcher, S. Leyffer, Math. Program. 91, 2002; A. Waechter, L. T. Biegler, Math. Program. 106, 2006, section 2.3.
    """
    cost, old = call.scales.cost, s["filter"]
    slack = 1e-12 * (cost + ca.fabs(s["phi"]))
    used = ca.DM(np.arange(FILTER)) < s["filtered"]
    worse = ca.logic_and(theta > (1 - 1e-5) * old[:, 0], phi > old[:, 1] - 1e-5 * old[:, 0] * cost)
    dominated = ca.mmax(ca.logic_and(used, worse))
    both = ca.logic_and(theta <= s["theta"], phi <= s["phi"] + slack)
    promise = ca.fmax(-s["alpha"] * s["dphi"] / cost, 0) ** 2.3
    small = ca.logic_and(s["dphi"] < 0, s["theta"] <= 1e-4 * call.ocp.stages)
    descends = ca.logic_and(small, promise > s["theta"] ** 1.1)
    armijo = phi <= s["phi"] + 1e-4 * s["alpha"] * s["dphi"] + slack
    falls = ca.logic_or(theta <= (1 - 1e-5) * s["theta"], phi <= s["phi"] - 1e-5 * s["theta"] * cost)
    passes = ca.if_else(both, 1, ca.if_else(descends, armijo, falls))
    passes = ca.logic_and(passes, ca.logic_not(dominated))
    joins = ca.logic_and(ca.logic_and(passes, falls), ca.logic_not(ca.logic_or(both, descends)))
    joins = ca.logic_and(joins, s["filtered"] < FILTER)
    place = ca.logic_and(joins, ca.DM(np.arange(FILTER)) == s["filtered"])
    pair = ca.repmat(ca.horzcat(s["theta"], s["phi"]), FILTER, 1)
    return passes, {"filter": ca.if_else(ca.horzcat(place, place), pair, old), "filtered": s["filtered"] + joins}


def _trial(call: Call, s: State, p: Expansion) -> Interior:
    """Return slacks, elastics and multipliers after the step to p; the multipliers stay near mu / t."""
    stepped = s["t"] + s["alpha"] * s["dt"], s["e"] + s["alpha"] * s["de"]
    t, e = (ca.if_else(s["descends"], a, b) for a, b in zip(call.limits.path(p, s["mu"]), stepped, strict=True))
    z = s["z"] + s["alpha_dual"] * s["dz"]
    safe = ca.if_else(call.limits.present, t, 1)
    near = ca.fmin(ca.fmax(z, s["mu"] / (1e8 * safe)), 1e8 * s["mu"] / safe)
    return Interior(t, e, ca.if_else(call.limits.present, near, 0))


def merit(call: Call, p: Expansion, y: Interior, mu: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return theta = sum |gaps| / unit + sum |d - t + e| / unit and phi = V + sum (rho e - mu log e) - mu sum log t.

    Here d are the distances of the plan from its limits, t their slacks, and e the elastics of limits of states.
    """
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


def descending(s: State) -> ca.MX:
    """Whether the next plan of an interior phase is a descent."""
    return ca.logic_and(s["descends"] > 0, s["phase"] == INTERIOR)


def box(call: Call, s: State) -> tuple[ca.MX, ca.MX]:
    """Return the limits of the inputs of a rollout: a hair inside for descents, whose barrier they must not touch."""
    hair = ca.fmin(HAIR * ca.DM(call.scales.inputs), 0.25 * ca.fabs(call.upper - call.lower))
    inside = ca.if_else(descending(s), hair, 0)
    return call.lower + inside, call.upper - inside


def _falls_enough(s: State, phi: ca.MX, cost: float) -> ca.MX:
    """Whether psi falls by a share of its slope, and of the move itself: the exact Hessian may be nearly singular."""
    return phi <= s["phi"] + 1e-4 * s["alpha"] * s["dphi"] + 1e-12 * (cost + ca.fabs(s["phi"]))


def priced(call: Call, s: State, p: Expansion) -> State:
    """Return the state with psi and its slope in place of phi and its slope, and with their price."""
    apart, weight = _sum_of_gaps(call, p), ca.repmat(ca.DM(call.ocp.step * call.ocp.curvature), 1, call.ocp.stages)
    largest = ca.mmax(ca.fabs(s["swept"]) * call.spread)
    price = ca.if_else(s["price"] >= NEARLY * largest, s["price"], ABOVE * largest)
    least = -LEAST_DAMPING * ca.sum1(ca.vec(weight * s["du"] ** 2))
    slope = ca.fmin(s["dphi"] - price * apart, least)
    return {**s, "price": price, "phi": s["phi"] + price * apart, "dphi": slope}


def _sum_of_gaps(call: Call, p: Expansion) -> ca.MX:
    """Return the sum of |F(X, U) - X+| in units of the states."""
    return ca.sum1(ca.vec(ca.fabs((p.next_states - p.states[:, 1:]) / call.spread)))
