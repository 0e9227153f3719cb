"""One independent judge for every optimiser's plan: the first-order conditions by dense algebra.

The plan is rolled out; the gradient g and the sensitivity J of the limited states come from CasADi's automatic differentiation of
the rolled-out cost, not from any sweep. Multipliers of every limit that is met to 1e-6 of its range are fitted by non-negative
least squares, and the residual is the largest entry of

    gamma (g - sum z_i sign_i dw_i/dU) / (half range),      gamma = (half range)^2 / C.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.optimize import nnls

from fpirhc.horizon.problem import OptimalControl, rollout
from fpirhc.optimisers.state_limits import scales

_MET = 1e-6  # of the range: nearer limits may have a multiplier
_ROUGH = 1e-4  # the same for a rough judgement: interior-point methods end that far from limits of small multipliers


@dataclass(frozen=True)
class Judgement:
    """cost; residual of the first-order conditions; violation, relative to the limits' half ranges; all by rolling out."""

    cost: float
    residual: float
    violation: float
    rough: float


class Judge:
    """Judges plans of one problem."""

    def __init__(self, ocp: OptimalControl) -> None:
        self._ocp, self._scales = ocp, scales(ocp)
        s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, ocp.stages + 1)
        inputs = ca.MX.sym("U", ocp.input.size, ocp.stages)
        states, value, _ = rollout(ocp)(s0, inputs, data)
        limited = ca.vec(states[list(self._scales.bounded), 1:])
        flat = ca.vec(inputs)
        sensitivity = ca.jacobian(limited, flat)
        results = [value, ca.vec(states[:, 1:]), ca.gradient(value, flat), ca.densify(sensitivity)]
        self._values = ca.Function("values", [s0, inputs, data], results)

    def __call__(self, inputs: np.ndarray, s0: np.ndarray, data: np.ndarray) -> Judgement:
        """Return what is known about a plan (nu, N)."""
        ocp, measures = self._ocp, self._scales
        value, states, slope, sensitivity = (np.asarray(v.full()) for v in self._values(s0, inputs, data))
        if not (np.isfinite(states).all() and np.isfinite(slope).all() and np.isfinite(sensitivity).all()):
            return Judgement(np.inf, np.inf, np.inf, np.inf)
        places, n = list(measures.bounded), ocp.stages
        rows = states.reshape(n, -1)[:, places].ravel()
        values = np.concatenate([inputs.ravel(order="F"), rows])
        unit = np.concatenate([np.tile(measures.inputs, n), np.tile(measures.states[places], n)])
        lower = np.concatenate([np.tile(ocp.input_lower, n), np.tile(ocp.state_lower[places], n)])
        upper = np.concatenate([np.tile(ocp.input_upper, n), np.tile(ocp.state_upper[places], n)])
        violation = max(np.max((lower - values) / unit, initial=0.0), np.max((values - upper) / unit, initial=0.0))
        jacobian = np.vstack([np.eye(inputs.size), sensitivity])
        weight = np.tile(measures.inputs / measures.cost, n)[:, None]
        residuals = []
        for met in (_MET, _ROUGH):
            low, high = values <= lower + met * unit, values >= upper - met * unit
            columns = np.vstack([jacobian[low], -jacobian[high]]).T
            residuals.append(_left(weight * columns, (weight * slope).ravel()))
        return Judgement(float(value.item()), residuals[0], float(violation), residuals[1])


def _left(columns: np.ndarray, target: np.ndarray) -> float:
    """Largest entry of columns z - target for the best z >= 0."""
    if not columns.size:
        return float(np.abs(target).max())
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    try:
        best, _ = nnls(columns / size, target, maxiter=30 * columns.shape[1])
    except RuntimeError:
        return float("inf")
    return float(np.abs(columns / size @ best - target).max())
