"""One turn of the iteration with limits: expand a plan, judge it, and find the next one by a sweep.

A phase of pure steps accepts a plan that halves the scaled error E of the first-order conditions, and is patient for a few steps,
because a change of the active limits raises E at first. A phase of interior steps accepts a plan by a filter of (infeasibility
theta, barrier function phi) after Fletcher and Leyffer as in IPOPT, with a Levenberg-Marquardt term instead of a restoration:
limits of states give way anyway. Where mu is low enough pure steps end it; where they do not contract, an interior phase goes on.

The state of the iteration is a mapping of expressions; a turn returns what it changes.

References: R. Fletcher, S. Leyffer, Math. Program. 91, 2002; A. Waechter, L. T. Biegler, Math. Program. 106, 2006.
"""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from fpirhc.horizon.hessian_models import ExactHessian, GaussNewton
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.sweep import Expansion, expand, sweep
from fpirhc.optimisers.base import FINITE, is_finite
from fpirhc.optimisers.bounds import BOUNDARY, Interior, Limited
from fpirhc.optimisers.certified import Certified, barrier_error, certified, certify, largest_gap
from fpirhc.optimisers.guess import guesses
from fpirhc.optimisers.limited_settings import (
    FILTER,
    HOPELESS,
    MOST_RAISES,
    MU_END,
    MU_LEAST,
    MU_MOST,
    MU_ROUNDS,
    MU_WARM,
    NEAR,
    PATIENCE,
    PURE_STEPS,
    REFERENCE,
    ROLLED,
    SEVERAL,
    LimitedSettings,
)
from fpirhc.optimisers.scales import scales
from fpirhc.optimisers.search import deformed_move

State = dict[str, ca.MX]
PURE, INTERIOR = 0, 1
BEGINS, ENDS = 0, 1
KEPT, COLD, WARM = 0, 1, 2
_POINT = tuple(f"point_{name}" for name in Expansion._fields)
_LEAST_MOVE = 1e-300


@cache
def constant(value: float) -> ca.MX:
    """The number as an expression, the same object every time, so that `choose` leaves it alone."""
    return ca.MX(value)


def fixed(**values: float) -> State:
    """Entries of the state that are numbers."""
    return {name: constant(value) for name, value in values.items()}


def point(s: State) -> Expansion:
    """The best plan so far, expanded."""
    return Expansion(*(s[name] for name in _POINT))


def as_point(p: Expansion) -> State:
    """The state's entries for this plan."""
    return dict(zip(_POINT, p, strict=True))


class Turn:
    """Builds the expressions of a turn for one problem and one call's limits."""

    def __init__(
        self, ocp: OptimalControl, settings: LimitedSettings, data: ca.MX, lower: ca.MX, upper: ca.MX, s0: ca.MX
    ) -> None:
        self.ocp, self.settings, self.scales = ocp, settings, scales(ocp)
        self.limits = Limited(ocp, self.scales, lower, upper)
        self._given = (s0, data, lower, upper)
        damping = ocp.step * ocp.curvature, 0.01 * self.scales.cost / self.scales.states**2
        kinds = settings.hessian or ExactHessian(), GaussNewton()
        self._sweeps = [sweep(ocp, bend, self.scales.bounded, damping) for bend in kinds]
        self._deformed = deformed_move(settings.map, ocp.input.size * ocp.stages)
        self._expand, self._spread = expand(ocp), ca.repmat(ca.DM(self.scales.states), 1, ocp.stages)

    def turned(self, s: State) -> State:
        """Return the whole state after one turn."""
        final = s["count"] >= self.settings.iterations
        p, rolled, usable = self._next(s, final)
        s = {**s, **self._judged(s, p, rolled, usable)}
        done = self._limits_met(s)
        ends = ca.logic_or(ca.logic_or(final, s["stuck"]), done)
        s = {**s, "ends": ends, "count": s["count"] + ca.logic_not(ends)}
        needed = ca.logic_and(s["fresh"] == 0, ca.logic_or(s["accepted"], s["again"]))
        return self._directed(s, ca.logic_and(needed, ca.logic_not(ends)))

    def _limits_met(self, s: State) -> ca.MX:
        last = Certified(s["error"] * 0, s["last_left"], s["last_violation"], s["last_broken"], s["last_error"])
        return ca.logic_and(ca.logic_and(s["fresh"] == 0, s["phase"] == PURE), self.is_done(last))

    def is_done(self, c: Certified) -> ca.MX:
        """Whether a plan meets the first-order conditions to the tolerances."""
        t = self.settings
        kept = ca.logic_and(c.broken <= t.feasible, c.error <= t.scaled_tolerance(self.scales))
        return ca.logic_and(c.left <= t.tolerance, kept)

    def _next(self, s: State, final: ca.MX) -> tuple[Expansion, ca.MX, ca.MX]:
        """The next plan, expanded; whether it is rolled out, and whether it is finite."""
        old, fresh = point(s), s["fresh"] > 0
        pure = ca.logic_and(ca.logic_not(fresh), s["phase"] == PURE)
        share = ca.if_else(ca.logic_or(fresh, pure), 0, s["alpha"])
        deformed = ca.reshape(self._deformed(ca.vec(s["v"])), old.inputs.shape)
        inputs = old.inputs + ca.if_else(share > 0, share * s["du"], 0) + ca.if_else(pure, deformed, 0)
        states = old.states + ca.if_else(share > 0, share * s["dx"], 0)
        starts = ca.logic_and(ca.logic_and(s["fresh"] == 1, s["slacks"] == COLD), s["start"] == ROLLED)
        last = ca.logic_and(final, int(self.settings.realtime))
        rolled = ca.if_else(fresh, starts, ca.logic_or(pure, last))
        s0, data, lower, upper = self._given
        p = Expansion(*self._expand(inputs, states, s["gains"], rolled, s0, data, lower, upper))
        numbers = [p.value, p.following, p.by_state, p.by_input, p.tail, p.a, p.b]
        return p, rolled, is_finite(ca.vertcat(*(ca.vec(v) for v in numbers)))

    def _judged(self, s: State, p: Expansion, rolled: ca.MX, usable: ca.MX) -> State:
        fresh, pure = s["fresh"] > 0, s["phase"] == PURE
        ways = [
            self._judge_fresh(s, p, rolled, usable),
            self._judge_pure(s, p, usable),
            self._judge_interior(s, p, usable),
        ]
        told = choose(s, fresh, ways[0], choose(s, pure, ways[1], ways[2]))
        return {**told, "rolled": ca.if_else(told["accepted"], rolled, s["rolled"])}

    def _judge_fresh(self, s: State, p: Expansion, rolled: ca.MX, usable: ca.MX) -> State:
        """A plan that was not made by a sweep: first guesses, remembered plans, and the last one again."""
        new = {**s, **as_point(p), **fixed(fresh=0)}
        far = ca.mmax(ca.fabs(p.states) - 100 * ca.horzcat(self._spread[:, 0], self._spread)) > 0
        fit = ca.logic_and(usable, ca.logic_not(ca.logic_and(rolled, far)))
        pure = self._enter_pure(new, BEGINS)
        if self.settings.realtime and self.settings.iterations < SEVERAL:
            pure = choose(pure, pure["error"] > NEAR, self._enter_interior(pure), pure)
        begun = choose(new, new["phase"] == PURE, pure, new)
        first = choose(s, fit, begun, {**self._restarted(new), **fixed(accepted=1)})
        again = choose(s, usable, new, {**s, **fixed(fresh=0)})
        retried = s["fresh"] == 2
        told = choose(s, retried, again, first)
        return {**told, "accepted": ca.if_else(retried, usable, 1)}

    def _judge_pure(self, s: State, p: Expansion, usable: ca.MX) -> State:
        c = self._certified(p, s["next_z"])
        halved = c.error <= 0.5 * s["error"]
        waits = ca.logic_and(s["misses"] < PATIENCE, c.error < HOPELESS)
        if self.settings.realtime:
            # A call of few iterations must have two left to get back inside.
            waits = ca.logic_and(waits, self.settings.iterations - s["count"] > 2)
        patient = ca.logic_and(ca.logic_or(halved, waits), s["steps"] + 1 <= PURE_STEPS)
        ok = ca.logic_and(ca.logic_and(usable, c.error < FINITE), patient)
        taken = {**s, **as_point(p), **_told(c), "z": s["next_z"], "costates": s["swept"], "steps": s["steps"] + 1}
        taken["misses"] = ca.if_else(halved, 0, s["misses"] + 1)
        taken["error"] = ca.if_else(halved, c.error, s["error"])
        better = ca.logic_and(halved, s["place_of"] == BEGINS)
        taken = choose(taken, better, {**taken, **_kept(taken)}, taken)
        return choose(s, ok, {**taken, **fixed(accepted=1)}, {**self._enter_interior(s), **fixed(accepted=0)})

    def _judge_interior(self, s: State, p: Expansion, usable: ca.MX) -> State:
        y = self._trial(s)
        theta, phi = self._merit(p, y, s["mu"])
        finite = ca.logic_and(ca.fabs(phi) <= FINITE, ca.fabs(theta) <= FINITE)
        passes, filtered = self._passes(s, theta, phi)
        if self.settings.realtime:
            passes, filtered = ca.MX(1), {}
        ok = ca.logic_and(ca.logic_and(usable, finite), passes)
        taken = {**s, **filtered, **as_point(p), "t": y.t, "e": y.e, "z": y.z}
        taken["costates"] = s["costates"] + s["alpha"] * (s["swept"] - s["costates"])
        taken = self._advanced(taken)
        # What the filter learned is kept where the plan is rejected for another reason, as in the loops in C.
        failed = {**s, **choose(s, ca.logic_and(usable, finite), {**s, **filtered}, s)}
        return choose(s, ok, {**taken, **fixed(accepted=1)}, {**self._shortened(failed), **fixed(accepted=0)})

    def _advanced(self, s: State) -> State:
        """After an accepted interior plan: mu, and whether pure steps may end the phase."""
        p = point(s)
        rest, least, most = barrier_error(self.limits, self.scales, p, Interior(s["t"], s["e"], s["z"]), s["costates"])
        if self.settings.realtime:
            s = {**s, "mu": self._adapted(s, rest), **_told(self._certified(p, s["z"]))}
            near = s["last_error"] < NEAR
            return choose(s, near, self._enter_pure(s, BEGINS), s)
        halvings, delta = s["halvings"], s["delta"]
        eased = ca.if_else(delta > 5e-7, delta / 5, 0)
        delta = ca.if_else(halvings >= 3, ca.fmax(4 * delta, 1e-4), ca.if_else(halvings > 0, delta, eased))
        cost, mu, filtered, going = self.scales.cost, s["mu"], s["filtered"], ca.MX(1)
        for _ in range(MU_ROUNDS):
            apart = ca.if_else(least < FINITE, mu - least, 0)
            worst = ca.fmax(rest, ca.fmax(most - mu, apart) / cost)
            going = ca.logic_and(going, ca.logic_not(ca.logic_or(worst > 10 * mu / cost, mu <= s["floor"])))
            lower = ca.fmax(s["floor"], ca.fmin(0.2 * mu, mu * ca.sqrt(mu / cost)))
            mu, filtered = ca.if_else(going, lower, mu), ca.if_else(going, 0, filtered)
        s = {**s, "mu": mu, "filtered": filtered, "delta": delta, **fixed(halvings=0, raises=0)}
        close = ca.fmax(rest, most / cost) <= 0.3 * ca.sqrt(s["floor"] / cost)
        return choose(s, ca.logic_and(mu <= s["floor"], close), self._enter_pure(s, ENDS), s)

    def _adapted(self, s: State, rest: ca.MX) -> ca.MX:
        """Return mu of a real-time iteration, which follows how well the last step went."""
        cost, mu, alpha = self.scales.cost, s["mu"], s["alpha"]
        badly = ca.logic_or(alpha < 0.5, rest > 0.3)
        well = ca.logic_and(alpha > 0.9, rest < 0.05)
        lower = ca.fmax(mu / 5, MU_WARM * cost)
        return ca.if_else(badly, ca.fmin(10 * mu, MU_MOST * cost), ca.if_else(well, lower, mu))

    def _shortened(self, s: State) -> State:
        """After a rejected interior plan: a shorter step, then more damping, then another first plan."""
        halved = {**s, "halvings": s["halvings"] + 1, "alpha": 0.5 * s["alpha"]}
        more = {"delta": ca.fmax(10 * s["delta"], 1e-3), "raises": s["raises"] + 1}
        raised = {**s, **fixed(halvings=0, filtered=0), **more}
        if self.settings.realtime:
            return self._restarted(raised)
        gives_up = ca.logic_or(raised["raises"] > MOST_RAISES, raised["delta"] > 1e8)
        raised = choose(s, gives_up, self._restarted(raised), {**raised, **fixed(again=1)})
        return choose(s, s["halvings"] + 1 <= 8, halved, raised)

    def _passes(self, s: State, theta: ca.MX, phi: ca.MX) -> tuple[ca.MX, State]:
        """Whether the filter lets a plan pass, and the filter afterwards."""
        cost, old = self.scales.cost, s["filter"]
        slack = 1e-12 * (cost + ca.fabs(s["phi"]))
        used = ca.DM(np.arange(FILTER)) < s["filtered"]
        worse = ca.logic_and(theta > (1 - 1e-5) * old[:, 0], phi > old[:, 1] - 1e-5 * old[:, 0] * cost)
        dominated = ca.mmax(ca.logic_and(used, worse))
        both = ca.logic_and(theta <= s["theta"], phi <= s["phi"] + slack)
        promise = ca.fmax(-s["alpha"] * s["dphi"] / cost, 0) ** 2.3
        small = ca.logic_and(s["dphi"] < 0, s["theta"] <= 1e-4 * self.ocp.stages)
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

    def _trial(self, s: State) -> Interior:
        t, e = s["t"] + s["alpha"] * s["dt"], s["e"] + s["alpha"] * s["de"]
        z = s["z"] + s["alpha_dual"] * s["dz"]
        safe = ca.if_else(self.limits.present, t, 1)
        kept = ca.fmin(ca.fmax(z, s["mu"] / (1e8 * safe)), 1e8 * s["mu"] / safe)
        return Interior(t, e, ca.if_else(self.limits.present, kept, 0))

    def _merit(self, p: Expansion, y: Interior, mu: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return (theta, phi)."""
        limits, gaps = self.limits, (p.following - p.states[:, 1:]) / self._spread
        apart = ca.if_else(limits.present, ca.fabs(limits.distance(p) - y.t + y.e) / limits.unit, 0)
        states = ca.logic_and(limits.present, limits.of_states)
        price = ca.if_else(states, limits.rho * y.e - mu * ca.log(ca.if_else(states, y.e, 1)), 0)
        barrier = price - mu * ca.log(ca.if_else(limits.present, y.t, 1))
        return ca.sum1(ca.vec(ca.fabs(gaps))) + ca.sum1(ca.vec(apart)), p.value + ca.sum1(ca.vec(barrier))

    def _merit_slope(self, s: State, p: Expansion) -> ca.MX:
        limits, n = self.limits, self.ocp.stages
        total = ca.dot(p.by_input, s["du"]) + ca.dot(p.by_state, s["dx"][:, :n]) + ca.dot(p.tail, s["dx"][:, n])
        states = ca.logic_and(limits.present, limits.of_states)
        price = ca.if_else(states, (limits.rho - s["mu"] / ca.if_else(states, s["e"], 1)) * s["de"], 0)
        slacks = ca.if_else(limits.present, s["mu"] * s["dt"] / ca.if_else(limits.present, s["t"], 1), 0)
        return total + ca.sum1(ca.vec(price - slacks))

    def _certified(self, p: Expansion, z: ca.MX) -> Certified:
        return certified(self.ocp, self.limits, self.scales, p, z)

    def _enter_pure(self, s: State, place: int) -> State:
        c = self._certified(point(s), s["z"])
        return {**s, **_kept(s), **_told(c), "error": c.error, **fixed(phase=PURE, place_of=place, misses=0, steps=0)}

    def _enter_interior(self, s: State) -> State:
        """Leave the pure phase: for an interior phase near its best plan, or back to the interior plan it came from."""
        cost = self.scales.cost
        s = {**s, **fixed(phase=INTERIOR, again=1, filtered=0, raises=0, halvings=0)}
        back = {
            **s,
            "point_inputs": s["kept_inputs"],
            "point_states": s["kept_states"],
            "z": s["kept_z"],
            **fixed(fresh=1),
        }
        warm = constant(MU_WARM * cost)
        mu = ca.fmin(ca.fmax(s["mu"], warm), MU_MOST * cost) if self.settings.realtime else warm
        near = {"mu": mu, **fixed(slacks=WARM, floor=MU_END * cost)}
        starts = choose(s, s["misses"] == 0, {**s, **near}, {**back, **near})
        floor = 0.01 * s["floor"]
        stuck = ca.logic_or(s["stuck"], floor < MU_LEAST * cost)
        return choose(
            s, s["place_of"] == BEGINS, starts, {**back, "floor": floor, "stuck": stuck, **fixed(slacks=KEPT)}
        )

    def _restarted(self, s: State) -> State:
        start = s["start"] + 1
        cold = self.cold({**s, "start": start}, None)
        return choose(s, start > REFERENCE, {**s, "start": start, **fixed(stuck=1)}, cold)

    def cold(self, s: State, inputs: ca.MX | None) -> State:
        """Begin without a memory: the inputs given or fed forward; the state held, rolled out, or the reference."""
        s0, data, lower, upper = self._given
        n, reach = self.ocp.stages, ca.DM(0.01 * self.scales.inputs)
        references, forward = guesses(self.ocp)(data)
        states = ca.if_else(s["start"] == REFERENCE, references, ca.repmat(s0, 1, n + 1))
        hair = ca.repmat(ca.fmin(reach, 0.25 * (upper - lower)), 1, n)
        begun = forward[:, :n] if inputs is None else inputs
        low, high = ca.repmat(lower, 1, n) + hair, ca.repmat(upper, 1, n) - hair
        none = {"gains": 0 * s["gains"], "costates": 0 * s["costates"]}
        held = {"point_inputs": ca.fmin(ca.fmax(begun, low), high), "point_states": states}
        zeros = fixed(filtered=0, raises=0, halvings=0, delta=0, bent=0)
        mu = fixed(mu=self.scales.cost, floor=MU_END * self.scales.cost)
        return {**s, **none, **held, **zeros, **mu, **fixed(phase=INTERIOR, slacks=COLD, fresh=1)}

    def _directed(self, s: State, needed: ca.MX) -> State:
        """Sweep for the next plan where it is needed: pure, or interior with the largest step that stays inside."""
        p, pure = point(s), s["phase"] == PURE
        slope = certify(self.ocp, self.limits, p, s["z"])
        weights, leans, held = self.limits.pure(p, s["z"], slope, largest_gap(p, self.scales))
        y = Interior(s["t"], s["e"], s["z"])
        placed = self.limits.inside(p, s["z"], s["mu"], s["slacks"] == WARM)
        y = Interior(*(ca.if_else(s["slacks"] == KEPT, a, b) for a, b in zip(y, placed, strict=True)))
        barrier = self.limits.interior(p, y, s["mu"])
        weight, lean = (ca.if_else(pure, a, b) for a, b in zip((weights, leans), barrier, strict=True))
        v, gains, dx, du, swept, ok = self._swept(s, p, weight, lean, needed)
        moved = {"v": v, "gains": gains, "dx": dx, "du": du, "swept": swept}
        now = {**s, "z": ca.if_else(pure, held, y.z), **fixed(again=0, bent=1)}
        now = choose(now, pure, now, {**now, "t": y.t, "e": y.e, **fixed(slacks=KEPT)})
        delta = ca.fmax(10 * s["delta"], 1e-6)
        failed = {**now, "delta": delta, "stuck": ca.logic_or(s["stuck"], delta > 1e8), **fixed(fresh=2)}
        after = {**now, **moved}
        steps = {**after, "next_z": self.limits.pure_multipliers(p, held, du, dx)}
        by = self.limits.moves(p, y, s["mu"], du, dx)
        tau = ca.fmax(BOUNDARY, 1 - s["mu"] / self.scales.cost)
        alpha, alpha_dual = self.limits.shares(y, by, tau)
        inside = {**after, "dt": by.t, "de": by.e, "dz": by.z, "alpha": alpha, "alpha_dual": alpha_dual}
        inside["theta"], inside["phi"] = self._merit(p, y, s["mu"])
        inside["dphi"] = self._merit_slope(inside, p)
        found = choose(now, ok, choose(after, pure, steps, inside), failed)
        return choose(s, needed, found, s)

    def _swept(self, s: State, p: Expansion, weight: ca.MX, lean: ca.MX, needed: ca.MX) -> list[ca.MX]:
        arguments = [*p, weight, lean, s["costates"], s["delta"], self._given[1]]
        exact, plain = self._sweeps
        none = _refusing(exact)
        first = ca.Function.if_else("fpirhc_sweep_exact", exact, none)(ca.logic_and(needed, s["bent"]), *arguments)
        failed = ca.logic_and(needed, first[-1] == 0)
        second = ca.Function.if_else("fpirhc_sweep_plain", plain, none)(failed, *arguments)
        return [ca.if_else(failed, b, a) for a, b in zip(first, second, strict=True)]


def choose(base: State, condition: ca.MX, yes: State, no: State) -> State:
    """Return the state that is `yes` or `no`; what is the same object in both is left alone."""
    told: State = {}
    yes, no = {**base, **yes}, {**base, **no}
    for name in {**yes, **no}:
        one, other = yes[name], no[name]
        told[name] = one if one is other else ca.if_else(condition, one, other)
    return told


def _kept(s: State) -> State:
    return {"kept_inputs": s["point_inputs"], "kept_states": s["point_states"], "kept_z": s["z"]}


def _told(c: Certified) -> State:
    return {"last_error": c.error, "last_left": c.left, "last_violation": c.violation, "last_broken": c.broken}


def _refusing(function: ca.Function) -> ca.Function:
    """The same signature, with results of zero."""
    inputs = [ca.MX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    return ca.Function("fpirhc_no_sweep", inputs, [ca.MX.zeros(*function.size_out(k)) for k in range(function.n_out())])
