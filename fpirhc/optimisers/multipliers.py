"""Multipliers of state bounds, fitted to a plan after the fact, so that it can be verified without its optimiser.

At a solution g + (dS/dU)' M = 0 in every input that is not at its own bound, with M > 0 only at an upper state bound and
M < 0 only at a lower one: a non-negative least-squares problem.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.rollout import reduced_gradient, rollout
from fpirhc.optimisers.base import FEASIBLE

_AT_BOUND = 1e-6  # relative distance within which an input counts as at its bound


def fit_multipliers(
    ocp: OptimalControl, inputs: np.ndarray, state: np.ndarray, data: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return M (ns, N), each entry with the sign of its bound; zero where no state is at a bound.

    Args:
        ocp: the problem.
        inputs: U, shape (nu, N).
        state: s_0, shape (ns,).
        data: shape (ntheta, N + 1).
        bounds: lower and upper limits of the inputs, shape (nu,) each.
    """
    none = np.zeros((ocp.state.size, ocp.stages))
    if not ocp.bounds_states:
        return none
    slope, states, sensitivity = (np.asarray(v.full()) for v in sensitivity_of(ocp)(state, inputs, data))
    flat = states[:, 1:].ravel(order="F")
    upper = flat >= np.tile(ocp.state_upper, ocp.stages) - FEASIBLE
    lower = flat <= np.tile(ocp.state_lower, ocp.stages) + FEASIBLE
    free = ~_at_bound(inputs, bounds).ravel(order="F")
    if not (upper.any() or lower.any()) or not free.any() or not np.isfinite(sensitivity).all():
        return none
    # Rows in the units of the stationarity, so that the fit weighs what is judged.
    weight = np.tile(1 / (ocp.step * ocp.curvature), ocp.stages)[free]
    columns = weight[:, None] * sensitivity.T[free]
    return _fit(columns, -weight * slope.ravel(order="F")[free], upper, lower).reshape(none.shape, order="F")


def _fit(columns: np.ndarray, target: np.ndarray, upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    from scipy.optimize import nnls

    signed = np.hstack([columns[:, upper], -columns[:, lower]])
    size = np.maximum(np.linalg.norm(signed, axis=0), 1e-300)
    weights, _ = nnls(signed / size, target)
    fitted = np.zeros(upper.size)
    fitted[upper] += (weights / size)[: upper.sum()]
    fitted[lower] -= (weights / size)[upper.sum() :]
    return fitted


def _at_bound(inputs: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    near = _AT_BOUND * (1 + np.abs(inputs))
    return (inputs <= bounds[0][:, None] + near) | (inputs >= bounds[1][:, None] - near)


def sensitivity_of(ocp: OptimalControl) -> ca.Function:
    """Return the Function (s0, U, data) -> (g, S, d vec(s_1 ... s_N) / d vec(U))."""
    s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, ocp.stages + 1)
    inputs = ca.MX.sym("U", ocp.input.size, ocp.stages)
    states, _, _ = rollout(ocp)(s0, inputs, data)
    slope = reduced_gradient(ocp)(s0, inputs, data, ca.MX.zeros(ocp.state.size, ocp.stages))[1]
    sensitivity = ca.jacobian(ca.vec(states[:, 1:]), ca.vec(inputs))
    return ca.Function("fpirhc_sensitivity", [s0, inputs, data], [slope, states, ca.densify(sensitivity)])
