"""Judges a plan of a pure step: by the scaled error E of the first-order conditions, with patience for a few steps."""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.limited_settings import AHEAD, HOPELESS, PATIENCE, PURE_STEPS
from fpirhc.optimisers.limited_turn.call import Call
from fpirhc.optimisers.limited_turn.phases import enter_interior
from fpirhc.optimisers.limited_turn.state import BEGINS, State, as_best, as_last, as_point, choose, fixed
from fpirhc.symbolic.expression import FINITE


def judge_pure(call: Call, s: State, p: Expansion, usable: ca.MX) -> State:
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
