"""State bounds as terms of the cost by an augmented Lagrangian, for optimisers that keep input bounds only.

For a bounded state x with multiplier y and weight w, every stage (and the end) gets the term

    w/2 dist^2(x + y/w, [lower, upper]),      and after a solve      y <- w (x + y/w - clip(x + y/w, lower, upper)).

Its gradient is the multiplier that the update gives, so the stationarity of the augmented problem is that of the constrained one
with the new multipliers. w_k = 10 rho / c_k, with c_k the compliance of the state along the reference, the middle eigenvalue of
J M^-1 J', makes most patterns of violation shrink by an order of magnitude per update. A larger rho helps where that is not enough.

References:
    M. R. Hestenes, J. Optim. Theory Appl. 4(5), 1969.
    R. T. Rockafellar, SIAM J. Control 12(2), 1974.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.horizon.hessian_models import stage_symbols
from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.layout import Expression, Layout, Signal, scalar

_STIFFNESS = 10.0
_REACHABLE = 1e-6  # relative eigenvalue below which the inputs do not reach a pattern in time


def bounded_states(ocp: OptimalControl) -> list[int]:
    """Places of the states that have a bound."""
    return [int(k) for k in np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper))]


def augmented(ocp: OptimalControl) -> OptimalControl:
    """Return the problem without state bounds whose data end with rho and the multipliers of each node's bounded states."""
    places, weights = bounded_states(ocp), penalty_weights(ocp)
    s, u, theta = stage_symbols(ocp)
    y, factor = ca.SX.sym("y", len(places)), ca.SX.sym("rho")
    penalty = _penalty(ocp, s, y, places, factor * weights)
    cost, terms = ocp.stage_cost(s, u, theta)
    augmented_data = ca.vertcat(theta, factor, y)
    names = tuple(ocp.state.elements[k] for k in places)
    stage = ca.Function("fpirhc_augmented_stage", [s, u, augmented_data], [cost + penalty, ca.vertcat(terms, penalty)])
    final = ca.Function("fpirhc_augmented_end", [s, augmented_data], [ocp.terminal_cost(s, theta) + penalty])
    dynamics = ca.Function("fpirhc_dynamics", [s, u, augmented_data], [ocp.dynamics(s, u, theta)])
    states, inputs, data = ocp.nodes
    # The curvature where every bound is active: the plain fixed-point step must be short enough there.
    steepest = np.zeros((ocp.state.size, ocp.state.size))
    steepest[places, places] = weights
    along = replace(ocp.along, q=ocp.along.q + steepest, final=ocp.along.final + steepest)
    return replace(
        ocp,
        data=Layout((*ocp.data.signals, scalar("penalty"), Signal("multipliers", names))),
        dynamics=dynamics,
        stage_cost=stage,
        terminal_cost=final,
        terms=(*ocp.terms, "state limits"),
        state_lower=np.full(ocp.state.size, -np.inf),
        state_upper=np.full(ocp.state.size, np.inf),
        along=along,
        nodes=(states, inputs, np.vstack([data, np.ones((1, data.shape[1])), np.zeros((len(places), data.shape[1]))])),
    )


def updated_multipliers(ocp: OptimalControl) -> ca.Function:
    """Function (S (ns, N + 1), rho, Y (bounded, N)) -> Y of s_1 ... s_N after a solve."""
    places, weights = bounded_states(ocp), penalty_weights(ocp)
    states, before = ca.MX.sym("S", ocp.state.size, ocp.stages + 1), ca.MX.sym("Y", len(places), ocp.stages)
    rows, factor = [], ca.MX.sym("rho")
    for row, (k, one) in enumerate(zip(places, weights, strict=True)):
        weight = factor * one
        shifted = states[k, 1:] + before[row, :] / weight
        rows.append(weight * (shifted - ca.fmin(ca.fmax(shifted, ocp.state_lower[k]), ocp.state_upper[k])))
    return ca.Function("fpirhc_updated_multipliers", [states, factor, before], [ca.vertcat(*rows)])


def penalty_weights(ocp: OptimalControl) -> np.ndarray:
    """Return w of every bounded state, in cost per unit of the state squared."""
    sensitivity, model = ocp.along.sensitivity(), ocp.along.hessian()
    ridge = 1e-9 * np.trace(model) / model.shape[0]
    reach = np.array([_reach(sensitivity[:, k], model + ridge * np.eye(model.shape[0])) for k in bounded_states(ocp)])
    # A state that no input reaches along the reference has the weight of the others.
    usable = np.isfinite(reach) & (reach > 0)
    return _STIFFNESS / np.where(usable, reach, reach[usable].max() if usable.any() else 1.0)


def _reach(rows: np.ndarray, model: np.ndarray) -> float:
    """Middle eigenvalue of J M^-1 J': effect of a state's multipliers on it, between smooth and sharp patterns in time."""
    try:
        values = np.linalg.eigvalsh(rows @ np.linalg.solve(model, rows.T))
        return float(np.median(values[values >= _REACHABLE * values[-1]]))
    except np.linalg.LinAlgError:
        return float("nan")


def _penalty(ocp: OptimalControl, s: Expression, y: Expression, places: list[int], weights: Expression) -> Expression:
    total = ca.SX(0)
    for row, k in enumerate(places):
        weight = weights[row]
        shifted = s[k] + y[row] / weight
        above = ca.fmax(shifted - ocp.state_upper[k], 0) if np.isfinite(ocp.state_upper[k]) else 0
        below = ca.fmax(ocp.state_lower[k] - shifted, 0) if np.isfinite(ocp.state_lower[k]) else 0
        total += 0.5 * weight * (above**2 + below**2)
    return total
