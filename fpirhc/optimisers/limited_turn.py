"""One turn of the iteration with limits: expand a plan, judge it, and find the next one by a sweep.

A phase of pure steps accepts a plan that halves the scaled error E of the first-order conditions. It is patient for a few steps,
because a change of the active limits raises E at first. A phase of interior steps accepts a plan by a filter of (infeasibility
theta, barrier function phi) after Fletcher and Leyffer as in IPOPT. Where the filter accepts none, a Levenberg-Marquardt term
grows, then another first plan is tried, and at last descents. Limits of states give way, so nothing else is to be
restored. Where mu is low enough pure steps end the phase; where they do not contract, an interior phase goes on.

References: R. Fletcher, S. Leyffer, Math. Program. 91, 2002; A. Waechter, L. T. Biegler, Math. Program. 106, 2006.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.hessian_models import ExactHessian, GaussNewton
from fpirhc.horizon.sweep import Expansion, expand, sweep
from fpirhc.optimisers.base import FEASIBLE, stationarity
from fpirhc.optimisers.bounds import BOUNDARY, Interior
from fpirhc.optimisers.certified import Certified, certify, largest_gap
from fpirhc.optimisers.limited_interior import box, descending, judge_interior, merit, merit_slope, priced
from fpirhc.optimisers.limited_settings import AHEAD, HOPELESS, PATIENCE, PURE_STEPS, ROLLED
from fpirhc.optimisers.limited_state import (
    BEGINS,
    COLD,
    KEPT,
    PURE,
    WARM,
    Call,
    State,
    as_best,
    as_last,
    as_point,
    choose,
    enter_interior,
    enter_pure,
    fixed,
    point,
    restart,
)
from fpirhc.optimisers.search import deformed_move
from fpirhc.symbolic.expression import FINITE, is_finite


class Turn:
    """Builds the expressions of a turn.

    Args:
        call: the problem and its arguments.
    """

    def __init__(self, call: Call) -> None:
        ocp = call.ocp
        self._call, self._direction, self._expand = call, _Direction(call), expand(ocp)
        self._deformed = deformed_move(call.settings.map, ocp.input.size * ocp.stages)

    def turned(self, s: State) -> State:
        """Return the whole state after one turn."""
        final = s["count"] >= self._call.settings.iterations
        p, rolled, usable = self._next(s)
        s = {**s, **self._judged(s, p, rolled, usable)}
        met = self._limits_met(s)
        ends = ca.logic_or(ca.logic_or(final, s["stuck"]), met)
        s = {**s, "ends": ends, "met": met, "count": s["count"] + ca.logic_not(ends)}
        needed = ca.logic_and(s["fresh"] == 0, ca.logic_or(s["accepted"], s["again"]))
        return self._direction.directed(s, ca.logic_and(needed, ca.logic_not(ends)))

    def _limits_met(self, s: State) -> ca.MX:
        last = Certified(s["error"] * 0, s["last_left"], s["last_violation"], s["last_broken"], s["last_error"])
        left = returned_left(self._call, point(s), s["z"])
        done = ca.logic_and(self._call.is_done(last), left <= self._call.settings.tolerance)
        return ca.logic_and(ca.logic_and(s["fresh"] == 0, s["phase"] == PURE), done)

    def _next(self, s: State) -> tuple[Expansion, ca.MX, ca.MX]:
        """The next plan, expanded; whether it is rolled out, and whether it is finite."""
        call, old, fresh = self._call, point(s), s["fresh"] > 0
        pure = ca.logic_and(ca.logic_not(fresh), s["phase"] == PURE)
        share, descent = ca.if_else(ca.logic_or(fresh, pure), 0, s["alpha"]), descending(s)
        deformed = ca.reshape(self._deformed(ca.vec(s["v"])), old.inputs.shape)
        move = ca.if_else(descent, s["v"], s["du"])
        inputs = old.inputs + ca.if_else(share > 0, share * move, 0) + ca.if_else(pure, deformed, 0)
        states = old.states + ca.if_else(ca.logic_and(share > 0, ca.logic_not(descent)), share * s["dx"], 0)
        gaps = ca.if_else(descent, (1 - share) * (old.next_states - old.states[:, 1:]), 0)
        starts = ca.logic_and(ca.logic_and(s["fresh"] == 1, s["slacks"] == COLD), s["start"] == ROLLED)
        rolled = ca.if_else(fresh, starts, ca.logic_or(pure, descent))
        p = Expansion(*self._expand(inputs, states, s["gains"], rolled, gaps, call.s0, call.data, *box(call, s)))
        return p, rolled, is_usable(p)

    def _judged(self, s: State, p: Expansion, rolled: ca.MX, usable: ca.MX) -> State:
        fresh, pure = s["fresh"] > 0, s["phase"] == PURE
        guessed = self._judge_fresh(s, p, rolled, usable)
        stepped = _judge_pure(self._call, s, p, usable), judge_interior(self._call, s, p, usable)
        judged = choose(s, fresh, guessed, choose(s, pure, *stepped))
        whole = ca.logic_and(rolled, judged["descends"] == 0)
        return {**judged, "rolled": ca.if_else(judged["accepted"], whole, s["rolled"])}

    def _judge_fresh(self, s: State, p: Expansion, rolled: ca.MX, usable: ca.MX) -> State:
        """A plan that was not made by a sweep: first guesses, remembered plans, and the last one again."""
        call, new = self._call, {**s, **as_point(p), **fixed(fresh=0)}
        far = ca.mmax(ca.fabs(p.states) - 100 * ca.horzcat(call.spread[:, 0], call.spread)) > 0
        fit = ca.logic_and(usable, ca.logic_not(ca.logic_and(rolled, far)))
        pure = enter_pure(call, new, BEGINS)
        begun = choose(new, new["phase"] == PURE, pure, new)
        first = choose(s, fit, begun, {**restart(call, new), **fixed(accepted=1)})
        again = choose(s, usable, new, {**s, **fixed(fresh=0)})
        retried = s["fresh"] == 2
        judged = choose(s, retried, again, first)
        return {**judged, "accepted": ca.if_else(retried, usable, 1)}


def returned_left(call: Call, p: Expansion, z: ca.MX) -> ca.MX:
    """Return the stationarity with which a plan is returned: multipliers of limits that are not near count as zero."""
    slope = certify(call.ocp, call.limits, p, z, call.limits.distance(p) <= FEASIBLE)
    return stationarity(call.ocp, p.inputs, slope, call.lower, call.upper)


def is_usable(p: Expansion) -> ca.MX:
    """Whether the numbers of an expansion that a sweep reads are finite."""
    numbers = [p.value, p.next_states, p.by_state, p.by_input, p.tail, p.a, p.b]
    return is_finite(ca.vertcat(*(ca.vec(v) for v in numbers)))


def _judge_pure(call: Call, s: State, p: Expansion, usable: ca.MX) -> State:
    """Return the state with the plan accepted, or at the begin of an interior phase."""
    c = call.certified(p, s["next_z"])
    halved = c.error <= 0.5 * s["error"]
    waits = ca.logic_and(s["misses"] < PATIENCE, c.error < HOPELESS)
    patient = ca.logic_and(ca.logic_or(halved, waits), s["steps"] + 1 <= PURE_STEPS)
    ok = ca.logic_and(ca.logic_and(usable, c.error < FINITE), patient)
    taken = {**s, **as_point(p), **as_last(c), "z": s["next_z"], "costates": s["swept"], "steps": s["steps"] + 1}
    # Gauss-Newton goes on only where the contraction that was seen ends the call with one more step.
    arrives = c.error**2 <= AHEAD * call.settings.scaled_tolerance(call.scales) * s["error"]
    taken["use_exact"] = ca.logic_or(s["use_exact"], ca.logic_not(arrives))
    taken["misses"] = ca.if_else(halved, 0, s["misses"] + 1)
    taken["error"] = ca.if_else(halved, c.error, s["error"])
    better = ca.logic_and(halved, s["place_of"] == BEGINS)
    taken = choose(taken, better, {**taken, **as_best(taken)}, taken)
    return choose(s, ok, {**taken, **fixed(accepted=1)}, {**enter_interior(call, s), **fixed(accepted=0)})


class _Direction:
    """Builds the sweeps of one call: with the Hessian of the settings, and with Gauss-Newton where that is not convex.

    Args:
        call: the problem and its arguments.
    """

    def __init__(self, call: Call) -> None:
        ocp, scales = call.ocp, call.scales
        damping = ocp.step * ocp.curvature, 0.01 * scales.cost / scales.states**2
        models = call.settings.hessian or ExactHessian(), GaussNewton()
        self._call = call
        self._exact, self._plain = (sweep(ocp, model, scales.bounded, damping) for model in models)

    def directed(self, s: State, needed: ca.MX) -> State:
        """Return the state with the next step where one is needed; with more damping where the sweep fails."""
        call, limits, p, pure = self._call, self._call.limits, point(s), s["phase"] == PURE
        slope = certify(call.ocp, limits, p, s["z"])
        weights, leans, held = limits.pure(p, s["z"], slope, largest_gap(p, call.scales))
        y = Interior(s["t"], s["e"], s["z"])
        placed = limits.inside(p, s["z"], s["mu"], s["slacks"] == WARM)
        y = Interior(*(ca.if_else(s["slacks"] == KEPT, a, b) for a, b in zip(y, placed, strict=True)))
        t, e = limits.path(p, s["mu"])
        anew = ca.if_else(s["slacks"] == COLD, ca.if_else(limits.present, s["mu"] / t, 0), y.z)
        y = Interior(*(ca.if_else(s["descends"], a, b) for a, b in zip((t, e, anew), y, strict=True)))
        barrier = limits.interior(p, y, s["mu"])
        weight, lean = (ca.if_else(pure, a, b) for a, b in zip((weights, leans), barrier, strict=True))
        v, gains, dx, du, swept, ok = self._swept(s, p, weight, lean, needed)
        use_exact = ca.logic_or(s["use_exact"], ca.logic_not(pure))
        now = {**s, "z": ca.if_else(pure, held, y.z), "use_exact": use_exact, **fixed(again=0)}
        now = choose(now, pure, now, {**now, "t": y.t, "e": y.e, **fixed(slacks=KEPT)})
        delta = ca.fmax(10 * s["delta"], 1e-6)
        failed = {**now, "delta": delta, **fixed(fresh=2, use_exact=1)}
        failed = choose(failed, delta > 1e8, restart(call, failed), failed)
        stepped = {**now, "v": v, "gains": gains, "dx": dx, "du": du, "swept": swept}
        steps = {**stepped, "next_z": limits.pure_multipliers(p, held, du, dx)}
        inside = self._inside(stepped, p, y, s["mu"])
        directed = choose(now, ok, choose(stepped, pure, steps, inside), failed)
        return choose(s, needed, directed, s)

    def _inside(self, s: State, p: Expansion, y: Interior, mu: ca.MX) -> State:
        """The state with the moves of slacks, elastics and multipliers, their shares, and the measures of the filter."""
        call = self._call
        by = call.limits.moves(p, y, mu, s["du"], s["dx"])
        tau = ca.fmax(BOUNDARY, 1 - mu / call.scales.cost)
        alpha, alpha_dual = call.limits.shares(y, by, tau)
        inside = {**s, "dt": by.t, "de": by.e, "dz": by.z, "alpha": alpha, "alpha_dual": alpha_dual}
        inside["theta"], inside["phi"] = merit(call, p, y, mu)
        inside["dphi"] = merit_slope(call, inside, p)
        return choose(inside, inside["descends"] > 0, priced(call, inside, p), inside)

    def _swept(self, s: State, p: Expansion, weight: ca.MX, lean: ca.MX, needed: ca.MX) -> list[ca.MX]:
        arguments = [*p, weight, lean, s["costates"], s["delta"], self._call.data]
        none = _without_result(self._exact)
        exact_if = ca.Function.if_else("fpirhc_sweep_exact", self._exact, none)
        first = exact_if(ca.logic_and(needed, s["use_exact"]), *arguments)
        failed = ca.logic_and(needed, first[-1] == 0)
        second = ca.Function.if_else("fpirhc_sweep_plain", self._plain, none)(failed, *arguments)
        return [ca.if_else(failed, b, a) for a, b in zip(first, second, strict=True)]


def _without_result(function: ca.Function) -> ca.Function:
    """The same signature, with results of zero."""
    inputs = [ca.MX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    return ca.Function("fpirhc_no_sweep", inputs, [ca.MX.zeros(*function.size_out(k)) for k in range(function.n_out())])
