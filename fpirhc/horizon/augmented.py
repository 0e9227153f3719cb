"""State bounds moved into the cost by an augmented Lagrangian, so that an optimiser of input bounds can serve them.

For a bounded state x with multiplier y and weight w, every stage (and the end) gets the term

    w/2 dist^2(x + y/w, [lower, upper]),      and after a solve      y <- w (x + y/w - clip(x + y/w, lower, upper)).

Its gradient is the multiplier that the update gives, so the stationarity of the augmented problem is that of the constrained one
with the new multipliers. Weights come from how far the inputs can move a state: w_k = 100 / max_i sum_j (dx_ki/du_j)^2 D_j along
the reference, which makes the violation shrink to about a hundredth per update.

References: M. R. Hestenes, J. Optim. Theory Appl. 4(5), 1969; R. T. Rockafellar, SIAM J. Control 12(2), 1974.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.horizon.expansion import stage_symbols
from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.layout import Expression, Layout, Signal

_STIFFNESS = 100.0


def bounded_states(ocp: OptimalControl) -> list[int]:
    """Places of the states that have a bound."""
    return [int(k) for k in np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper))]


def augmented(ocp: OptimalControl) -> OptimalControl:
    """Return the problem without state bounds whose data end with the multipliers of each node's bounded states."""
    places, weights = bounded_states(ocp), penalty_weights(ocp)
    s, u, theta = stage_symbols(ocp)
    y = ca.SX.sym("y", len(places))
    penalty = _penalty(ocp, s, y, places, weights)
    cost, terms = ocp.stage_cost(s, u, theta)
    given = ca.vertcat(theta, y)
    names = tuple(ocp.state.elements[k] for k in places)
    stage = ca.Function("fpirhc_augmented_stage", [s, u, given], [cost + penalty, ca.vertcat(terms, penalty)])
    final = ca.Function("fpirhc_augmented_end", [s, given], [ocp.terminal_cost(s, theta) + penalty])
    dynamics = ca.Function("fpirhc_dynamics", [s, u, given], [ocp.dynamics(s, u, theta)])
    states, inputs, data = ocp.nodes
    return replace(
        ocp,
        data=Layout((*ocp.data.signals, Signal("multipliers", names))),
        dynamics=dynamics,
        stage_cost=stage,
        terminal_cost=final,
        terms=(*ocp.terms, "state limits"),
        state_lower=np.full(ocp.state.size, -np.inf),
        state_upper=np.full(ocp.state.size, np.inf),
        nodes=(states, inputs, np.vstack([data, np.zeros((len(places), data.shape[1]))])),
    )


def updated_multipliers(ocp: OptimalControl) -> ca.Function:
    """Function (S (ns, N + 1), Y (bounded, N)) -> Y of s_1 ... s_N after a solve."""
    places, weights = bounded_states(ocp), penalty_weights(ocp)
    states, before = ca.MX.sym("S", ocp.state.size, ocp.stages + 1), ca.MX.sym("Y", len(places), ocp.stages)
    rows = []
    for row, (k, weight) in enumerate(zip(places, weights, strict=True)):
        shifted = states[k, 1:] + before[row, :] / weight
        rows.append(weight * (shifted - ca.fmin(ca.fmax(shifted, ocp.state_lower[k]), ocp.state_upper[k])))
    return ca.Function("fpirhc_updated_multipliers", [states, before], [ca.vertcat(*rows)])


def penalty_weights(ocp: OptimalControl) -> np.ndarray:
    """Return w of every bounded state, in cost per unit of the state squared."""
    places, scale = bounded_states(ocp), 1 / (ocp.step * ocp.curvature)
    reach = np.zeros(len(places))
    moved = np.zeros((ocp.state.size, 0))
    for a, b in zip(ocp.along.a, ocp.along.b, strict=True):
        moved = np.hstack([a @ moved, b * np.sqrt(scale)])
        reach = np.maximum(reach, (moved[places] ** 2).sum(axis=1))
    # A state that no input moves along the reference is weighed like the others.
    usable = np.isfinite(reach) & (reach > 0)
    return _STIFFNESS / np.where(usable, reach, reach[usable].max() if usable.any() else 1.0)


def _penalty(ocp: OptimalControl, s: Expression, y: Expression, places: list[int], weights: np.ndarray) -> Expression:
    total = ca.SX(0)
    for row, (k, weight) in enumerate(zip(places, weights, strict=True)):
        shifted = s[k] + y[row] / weight
        above = ca.fmax(shifted - ocp.state_upper[k], 0) if np.isfinite(ocp.state_upper[k]) else 0
        below = ca.fmax(ocp.state_lower[k] - shifted, 0) if np.isfinite(ocp.state_lower[k]) else 0
        total += 0.5 * weight * (above**2 + below**2)
    return total
