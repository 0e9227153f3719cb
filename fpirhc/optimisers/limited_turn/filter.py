"""The filter of pairs (theta, phi) that decides whether an interior plan is accepted.

References: R. Fletcher, S. Leyffer, Math. Program. 91, 2002; A. Waechter, L. T. Biegler, Math. Program. 106, 2006, section 2.3.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.optimisers.limited_settings import FILTER
from fpirhc.optimisers.limited_turn.call import Call
from fpirhc.optimisers.limited_turn.state import State


def passes_filter(call: Call, s: State, theta: ca.MX, phi: ca.MX) -> tuple[ca.MX, State]:
    """Return whether the filter accepts a plan, and the filter afterwards."""
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
