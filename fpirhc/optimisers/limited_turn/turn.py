"""One turn of the iteration with limits: expand a plan, judge it, and find the next one by a sweep.

A phase of pure steps accepts a plan that halves the scaled error E of the first-order conditions. It is patient for a few steps,
because a change of the active limits raises E at first. A phase of interior steps accepts a plan by a filter of (infeasibility
theta, barrier function phi) after Fletcher and Leyffer as in IPOPT. Where the filter accepts none, a Levenberg-Marquardt term
grows, then another first plan is tried, and at last descents (`descent.py`). Limits of states give way, so nothing else is to be
restored. Where mu is low enough pure steps end the phase; where they do not contract, an interior phase goes on.

References: R. Fletcher, S. Leyffer, Math. Program. 91, 2002; A. Waechter, L. T. Biegler, Math. Program. 106, 2006.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.sweep import Expansion, expand
from fpirhc.optimisers.base import FEASIBLE, stationarity
from fpirhc.optimisers.certified import Certified, certify
from fpirhc.optimisers.limited_settings import ROLLED
from fpirhc.optimisers.limited_turn.call import Call
from fpirhc.optimisers.limited_turn.descent import box, descending
from fpirhc.optimisers.limited_turn.direction import Direction
from fpirhc.optimisers.limited_turn.interior import judge_interior
from fpirhc.optimisers.limited_turn.phases import enter_pure, restart
from fpirhc.optimisers.limited_turn.pure import judge_pure
from fpirhc.optimisers.limited_turn.state import BEGINS, COLD, PURE, State, as_point, choose, fixed, point
from fpirhc.optimisers.search import deformed_move
from fpirhc.symbolic.expression import is_finite


class Turn:
    """Builds the expressions of a turn.

    Args:
        call: the problem and its arguments.
    """

    def __init__(self, call: Call) -> None:
        ocp = call.ocp
        self._call, self._direction, self._expand = call, Direction(call), expand(ocp)
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
        stepped = judge_pure(self._call, s, p, usable), judge_interior(self._call, s, p, usable)
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
