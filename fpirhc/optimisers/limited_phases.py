"""The parts of a turn of the iteration with limits: its state, how a phase begins, and how an interior plan is judged.

A plan of an interior step is judged by a filter of infeasibility theta and barrier function phi. Where the filter has given up from
every first plan, descents follow (docs/theory.md): rollouts that carry a share of the gaps and lower
psi = phi + price sum |gaps| / unit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.riccati import Expansion
from fpirhc.optimisers import limited_settings as constants
from fpirhc.optimisers.bounds import HAIR, Certified, Interior, Limited, Scales, barrier_error, certified, scales
from fpirhc.optimisers.limited_settings import LimitedSettings
from fpirhc.symbolic.expression import FINITE

PURE, INTERIOR = 0, 1  # phase
BEGINS, ENDS = 0, 1  # place_of: whether a pure phase stands before an interior one or after it
AS_IS, COLD, WARM = 0, 1, 2  # slacks: as they are, made from the distances, or from the distances and the multipliers


@dataclass(frozen=True, eq=False)
class Call:
    """What all parts of a turn read.

    Args:
        ocp: the problem.
        settings: of the iteration.
        s0: the first state, shape (ns,).
        data: shape (ntheta, N + 1).
        lower: lower limits of the inputs, shape (nu,).
        upper: upper limits of the inputs, shape (nu,).
    """

    ocp: OptimalControl
    settings: LimitedSettings
    s0: ca.MX
    data: ca.MX
    lower: ca.MX
    upper: ca.MX
    scales: Scales = field(init=False)
    limits: Limited = field(init=False)
    spread: ca.DM = field(init=False)  # units of the states, shape (ns, N)

    def __post_init__(self) -> None:
        units = scales(self.ocp)
        object.__setattr__(self, "scales", units)
        object.__setattr__(self, "limits", Limited(self.ocp, units, self.lower, self.upper))
        object.__setattr__(self, "spread", ca.repmat(ca.DM(units.states), 1, self.ocp.stages))

    def certified(self, p: Expansion, z: ca.MX) -> Certified:
        """Return how far a plan with multipliers z is from the first-order conditions."""
        return certified(self.ocp, self.limits, self.scales, p, z)

    def is_done(self, c: Certified, room: float = 1) -> ca.MX:
        """Whether a plan meets the first-order conditions to the tolerances; limits to `room` times theirs."""
        t = self.settings
        feasible = ca.logic_and(c.broken <= room * t.feasible, c.error <= t.scaled_tolerance(self.scales))
        return ca.logic_and(c.left <= t.tolerance, feasible)


State = dict[str, ca.MX]
_POINT = tuple(f"point_{name}" for name in Expansion._fields)


@cache
def constant(value: float) -> ca.MX:
    """Return the number as an expression: the same object every time, so that `choose` does not change it."""
    return ca.MX(value)


def fixed(**values: float) -> State:
    """Return entries of the state that are numbers."""
    return {name: constant(value) for name, value in values.items()}


def point(s: State) -> Expansion:
    """Return the plan from which the next one starts, expanded."""
    return Expansion(*(s[name] for name in _POINT))


def as_point(p: Expansion) -> State:
    """Return the entries of the state that hold this plan."""
    return dict(zip(_POINT, p, strict=True))


def as_best(s: State) -> State:
    """Return the entries that hold the plan as the best one of its pure phase."""
    return {"best_inputs": s["point_inputs"], "best_states": s["point_states"], "best_z": s["z"]}


def as_last(c: Certified) -> State:
    """Return the entries that hold how far the last plan is from the first-order conditions."""
    return {"last_error": c.error, "last_left": c.left, "last_violation": c.violation, "last_broken": c.broken}


def choose(base: State, condition: ca.MX, yes: State, no: State) -> State:
    """Return `yes` or `no` over `base`; an entry that is the same object in both is not touched."""
    chosen_state: State = {}
    yes, no = {**base, **yes}, {**base, **no}
    for name in {**yes, **no}:
        one, other = yes[name], no[name]
        chosen_state[name] = one if one is other else ca.if_else(condition, one, other)
    return chosen_state


def enter_pure(call: Call, s: State, place: int) -> State:
    """Begin a phase of pure steps; `place` is BEGINS or ENDS."""
    c = call.certified(point(s), s["z"])
    begun = fixed(phase=PURE, place_of=place, misses=0, steps=0)
    return {**s, **as_best(s), **as_last(c), "error": c.error, **begun}


def enter_interior(call: Call, s: State) -> State:
    """Leave the pure phase: for an interior phase near its best plan, or back to the interior plan it came from."""
    cost = call.scales.cost
    s = {**s, **fixed(phase=INTERIOR, again=1, use_exact=1, filtered=0, raises=0, halvings=0)}
    best = {"point_inputs": s["best_inputs"], "point_states": s["best_states"], "z": s["best_z"]}
    back = {**s, **best, **fixed(fresh=1)}
    near = fixed(mu=constants.MU_WARM * cost, slacks=WARM, floor=constants.MU_END * cost)
    starts = choose(s, s["misses"] == 0, {**s, **near}, {**back, **near})
    floor = 0.01 * s["floor"]
    stuck = ca.logic_or(s["stuck"], floor < constants.MU_LEAST * cost)
    returns = {**back, "floor": floor, "stuck": stuck, **fixed(slacks=AS_IS)}
    return choose(s, s["place_of"] == BEGINS, starts, returns)


def restart(call: Call, s: State) -> State:
    """Begin again from the next first guess; the iteration is stuck after the last one."""
    start = s["start"] + 1
    cold = begin_cold(call, {**s, "start": start}, None)
    return choose(s, start > constants.LAST_START, {**s, "start": start, **fixed(stuck=1)}, cold)


def begin_cold(call: Call, s: State, inputs: ca.MX | None) -> State:
    """Begin without a memory.

    Args:
        s: the state, with the number of the first guess in `start`.
        inputs: first inputs (nu, N); None: the feedforward. The states are held at s0, or follow the reference.
    """
    n, reach = call.ocp.stages, ca.DM(0.01 * call.scales.inputs)
    references, forward = guesses(call.ocp)(call.data)
    on_reference = ca.logic_or(s["start"] == constants.REFERENCE, s["start"] == constants.DESCENT)
    states = ca.if_else(on_reference, references, ca.repmat(call.s0, 1, n + 1))
    hair = ca.repmat(ca.fmin(reach, 0.25 * (call.upper - call.lower)), 1, n)
    first = forward[:, :n] if inputs is None else inputs
    low, high = ca.repmat(call.lower, 1, n) + hair, ca.repmat(call.upper, 1, n) - hair
    none = {"gains": 0 * s["gains"], "costates": 0 * s["costates"]}
    guess = {"point_inputs": ca.fmin(ca.fmax(first, low), high), "point_states": states}
    descends = s["start"] >= constants.DESCENT
    zeros = fixed(filtered=0, raises=0, halvings=0, use_exact=0, price=call.scales.cost)
    zeros |= {"descends": descends, "delta": constants.LEAST_DAMPING * descends}
    mu = fixed(mu=call.scales.cost, floor=constants.MU_END * call.scales.cost)
    return {**s, **none, **guess, **zeros, **mu, **fixed(phase=INTERIOR, slacks=COLD, fresh=1)}


def guess(ocp: OptimalControl) -> ca.Function:
    """Function theta -> (reference as a stage's state (ns), feedforward (nu)).

    States without a reference are those of the nodes.
    """
    theta = ca.SX.sym("theta", ocp.data.size)
    reference, forward = (theta[ocp.data.slice(name)] for name in ("reference", "feedforward"))
    if ocp.inner:
        reference = ca.vertcat(*(reference[k] if k >= 0 else value for k, value in ocp.inner))
    rest = ocp.state.size - reference.numel() - ocp.written
    state = ca.vertcat(reference, *([forward] if rest else []), ca.SX.zeros(ocp.written))
    return ca.Function("fpirhc_guess", [theta], [ca.densify(state), ca.densify(forward)])


def guesses(ocp: OptimalControl) -> ca.Function:
    """Function data (ntheta, N + 1) -> (ns, N + 1), (nu, N + 1)."""
    return guess(ocp).map(ocp.stages + 1)


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
        "mu": ca.fmin(10 * s["mu"], constants.MU_MOST * cost),
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
    raisable = ca.logic_and(s["rewarms"] < constants.MOST_REWARMS, s["mu"] < constants.MU_MOST * call.scales.cost)
    return ca.logic_and(ca.logic_and(remembered, raisable), s["alpha"] < constants.POOR)


def _eased_damping(s: State) -> ca.MX:
    """The damping after an accepted plan: less after a whole step, more after a step that was halved often."""
    halvings, delta = s["halvings"], s["delta"]
    eased = ca.if_else(delta > 5e-7, delta / 5, 0)
    eased = ca.if_else(halvings >= 3, ca.fmax(4 * delta, 1e-4), ca.if_else(halvings > 0, delta, eased))
    return ca.if_else(s["descends"], ca.fmax(eased, constants.LEAST_DAMPING), eased)


def _lowered_barrier(call: Call, s: State, rest: ca.MX, products: tuple[ca.MX, ca.MX]) -> tuple[ca.MX, ca.MX]:
    """Lower mu as long as its barrier problem is solved; the filter is emptied with every reduction.

    `products`: the least and the largest product of the complementarity.
    """
    (least, most), cost = products, call.scales.cost
    mu, filtered, going = s["mu"], s["filtered"], ca.MX(1)
    for _ in range(constants.MU_ROUNDS):
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
    gives_up = ca.logic_or(ca.logic_or(s["start"] < 0, raised["raises"] > constants.MOST_RAISES), raised["delta"] > 1e8)
    again = {**raised, **fixed(again=1), "use_exact": ca.if_else(s["descends"], 0, s["use_exact"])}
    raised = choose(s, gives_up, restart(call, raised), again)
    return choose(s, s["halvings"] + 1 <= 8, halved, raised)


def _passes_filter(call: Call, s: State, theta: ca.MX, phi: ca.MX) -> tuple[ca.MX, State]:
    """Return whether the filter accepts a plan, and the filter afterwards.

    Sources: R. Fletcher, S. Leyffer, Math. Program. 91, 2002; A. Waechter, L. T. Biegler, Math. Program. 106, 2006, section 2.3.
    """
    cost, old = call.scales.cost, s["filter"]
    slack = constants.ROUNDING * (cost + ca.fabs(s["phi"]))
    used = ca.DM(np.arange(constants.FILTER)) < s["filtered"]
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
    joins = ca.logic_and(joins, s["filtered"] < constants.FILTER)
    place = ca.logic_and(joins, ca.DM(np.arange(constants.FILTER)) == s["filtered"])
    pair = ca.repmat(ca.horzcat(s["theta"], s["phi"]), constants.FILTER, 1)
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
    price = ca.if_else(states, limits.rho * y.e - mu * ca.log(ca.if_else(states, y.e / limits.unit, 1)), 0)
    barrier = price - mu * ca.log(ca.if_else(limits.present, y.t / limits.unit, 1))
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
    return phi <= s["phi"] + 1e-4 * s["alpha"] * s["dphi"] + constants.ROUNDING * (cost + ca.fabs(s["phi"]))


def priced(call: Call, s: State, p: Expansion) -> State:
    """Return the state with psi and its slope in place of phi and its slope, and with their price."""
    apart, weight = _sum_of_gaps(call, p), ca.repmat(ca.DM(call.ocp.step * call.ocp.curvature), 1, call.ocp.stages)
    largest = ca.mmax(ca.fabs(s["swept"]) * call.spread)
    price = ca.if_else(s["price"] >= constants.NEARLY * largest, s["price"], constants.ABOVE * largest)
    least = -constants.LEAST_DAMPING * ca.sum1(ca.vec(weight * s["du"] ** 2))
    slope = ca.fmin(s["dphi"] - price * apart, least)
    return {**s, "price": price, "phi": s["phi"] + price * apart, "dphi": slope}


def _sum_of_gaps(call: Call, p: Expansion) -> ca.MX:
    """Return the sum of |F(X, U) - X+| in units of the states."""
    return ca.sum1(ca.vec(ca.fabs((p.next_states - p.states[:, 1:]) / call.spread)))
