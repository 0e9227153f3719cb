"""Descents, where the filter has given up from every first plan: rollouts that carry a share of the gaps and lower one function,

    psi = phi + price sum |gaps| / unit,      x+ = F(x, u) - (1 - alpha) gap,      u = U + alpha v + K (x - X).

Slacks and elastics are those that belong to the distances, so phi is a function of the plan alone. The price stays above the
costates of the sweeps, so each sweep is a direction in which psi falls. A whole step leaves no gap, and none comes back.

References: S. P. Han, J. Optim. Theory Appl. 22, 1977; C. Mastalli et al., IEEE ICRA 2020, for the rollouts with gaps.
"""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.sweep import Expansion
from fpirhc.optimisers.bounds import HAIR
from fpirhc.optimisers.limited_settings import ABOVE, LEAST_DAMPING, NEARLY
from fpirhc.optimisers.limited_turn.call import Call
from fpirhc.optimisers.limited_turn.state import INTERIOR, State


def descending(s: State) -> ca.MX:
    """Whether the next plan of an interior phase is a descent."""
    return ca.logic_and(s["descends"] > 0, s["phase"] == INTERIOR)


def box(call: Call, s: State) -> tuple[ca.MX, ca.MX]:
    """Return the limits of the inputs of a rollout: a hair inside for descents, whose barrier they must not touch."""
    hair = ca.fmin(HAIR * ca.DM(call.scales.inputs), 0.25 * ca.fabs(call.upper - call.lower))
    inside = ca.if_else(descending(s), hair, 0)
    return call.lower + inside, call.upper - inside


def falls_enough(s: State, phi: ca.MX, cost: float) -> ca.MX:
    """Whether psi falls by a share of its slope, and of the move itself: the exact Hessian may be nearly singular."""
    return phi <= s["phi"] + 1e-4 * s["alpha"] * s["dphi"] + 1e-12 * (cost + ca.fabs(s["phi"]))


def priced(call: Call, s: State, p: Expansion) -> State:
    """Return the state with psi and its slope in place of phi and its slope, and with their price."""
    apart, weight = sum_of_gaps(call, p), ca.repmat(ca.DM(call.ocp.step * call.ocp.curvature), 1, call.ocp.stages)
    largest = ca.mmax(ca.fabs(s["swept"]) * call.spread)
    price = ca.if_else(s["price"] >= NEARLY * largest, s["price"], ABOVE * largest)
    least = -LEAST_DAMPING * ca.sum1(ca.vec(weight * s["du"] ** 2))
    slope = ca.fmin(s["dphi"] - price * apart, least)
    return {**s, "price": price, "phi": s["phi"] + price * apart, "dphi": slope}


def sum_of_gaps(call: Call, p: Expansion) -> ca.MX:
    """Return the sum of |F(X, U) - X+| in units of the states."""
    return ca.sum1(ca.vec(ca.fabs((p.next_states - p.states[:, 1:]) / call.spread)))
