"""Judges a plan of an interior step by the filter, and sets the barrier and the damping of the next one."""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.bounds import Interior
from fpirhc.optimisers.certified import barrier_error
from fpirhc.optimisers.limited_settings import LEAST_DAMPING, MOST_RAISES, MOST_REWARMS, MU_MOST, MU_ROUNDS, POOR
from fpirhc.optimisers.limited_turn.call import Call
from fpirhc.optimisers.limited_turn.descent import falls_enough, sum_of_gaps
from fpirhc.optimisers.limited_turn.filter import passes_filter
from fpirhc.optimisers.limited_turn.merit import merit, trial
from fpirhc.optimisers.limited_turn.phases import enter_pure, restart
from fpirhc.optimisers.limited_turn.state import BEGINS, ENDS, WARM, State, as_point, choose, fixed, point
from fpirhc.symbolic.expression import FINITE


def judge_interior(call: Call, s: State, p: Expansion, usable: ca.MX) -> State:
    """Return the state with the plan accepted, or with a shorter or more damped step."""
    y = trial(call, s, p)
    theta, phi = merit(call, p, y, s["mu"])
    phi += ca.if_else(s["descends"], s["price"] * sum_of_gaps(call, p), 0)
    finite = ca.logic_and(ca.fabs(phi) <= FINITE, ca.fabs(theta) <= FINITE)
    passes, filtered = passes_filter(call, s, theta, phi)
    passes = ca.if_else(s["descends"], falls_enough(s, phi, call.scales.cost), passes)
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
