"""One independent judge for every optimiser's plan: the first-order conditions by dense algebra.

The plan is rolled out; the gradient g and the sensitivity J of the limited states come from CasADi's automatic differentiation of
the rolled-out cost, not from any sweep. Multipliers of every limit that is met to 1e-6 of its range are fitted by non-negative
least squares, and the residual is the largest entry of

    gamma (g - sum z_i sign_i dw_i/dU) / (half range),      gamma = (half range)^2 / C.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import nnls

_MET = 1e-6  # of the range: nearer limits may have a multiplier


@dataclass(frozen=True)
class Judgement:
    """cost; residual of the first-order conditions; violation, relative to the limits' half ranges; all by rolling out."""

    cost: float
    residual: float
    violation: float


class Judge:
    """Judges plans of one problem."""

    def __init__(self, ocp: Any) -> None:
        s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, ocp.stages + 1)
        inputs, states, value = ca.MX.sym("U", ocp.input.size, ocp.stages), [s0], 0
        for k in range(ocp.stages):
            value += ocp.stage_cost(states[-1], inputs[:, k], data[:, k])[0]
            states.append(ocp.dynamics(states[-1], inputs[:, k], data[:, k]))
        value += ocp.terminal_cost(states[-1], data[:, ocp.stages])
        bounded = np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper)).tolist()
        limited, flat = ca.vec(ca.horzcat(*states[1:])[bounded, :]), ca.vec(inputs)
        results = [value, limited, ca.gradient(value, flat), ca.densify(ca.jacobian(limited, flat))]
        self._values = ca.Function("values", [s0, inputs, data], results)
        lower, upper = (
            np.concatenate([np.tile(own, ocp.stages), np.tile(state[bounded], ocp.stages)])
            for own, state in ((ocp.input_lower, ocp.state_lower), (ocp.input_upper, ocp.state_upper))
        )
        half = 0.5 * (upper - lower)
        self._lower, self._upper, self._unit = lower, upper, np.where(np.isfinite(half) & (half > 0), half, 1.0)
        own = self._unit[: ocp.input.size]
        self._weight = np.tile(own / np.median(own**2 / ocp.scale), ocp.stages)

    def __call__(self, inputs: np.ndarray, s0: np.ndarray, data: np.ndarray) -> Judgement:
        """Return what is known about a plan (nu, N)."""
        value, limited, slope, sensitivity = (np.asarray(v.full()) for v in self._values(s0, inputs, data))
        if not all(np.isfinite(v).all() for v in (limited, slope, sensitivity)):
            return Judgement(np.inf, np.inf, np.inf)
        values, unit = np.concatenate([inputs.ravel(order="F"), limited.ravel()]), self._unit
        violation = max(((self._lower - values) / unit).max(), ((values - self._upper) / unit).max(), 0.0)
        low, high = values <= self._lower + _MET * unit, values >= self._upper - _MET * unit
        jacobian = np.vstack([np.eye(inputs.size), sensitivity])
        columns = np.vstack([jacobian[low], -jacobian[high]]).T
        residual = _left(self._weight[:, None] * columns, self._weight * slope.ravel())
        return Judgement(float(value.item()), residual, float(violation))


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
