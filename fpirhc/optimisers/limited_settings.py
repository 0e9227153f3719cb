"""Numbers of the iteration with limits, for the loops in C and for the composed graph: the same for all problems."""

from __future__ import annotations

from dataclasses import dataclass

from fpirhc.deformation.base import Deformation
from fpirhc.horizon.hessian_models import HessianModel
from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.bounds import Scales, scales
from fpirhc.symbolic.layout import Layout, Signal, discrete

PATIENCE = 3  # pure steps in a row that may fail to halve the error: the active limits are changing
HOPELESS = 1e2  # scaled error from which on there is no patience: multipliers are at their largest value
AHEAD = 0.1  # of the tolerance: where one more step by Gauss-Newton is expected to arrive, the exact Hessian is not computed
PURE_STEPS = 10
# Times the violation at which a call ends: what is sent counts as converged, because the roll-out of a plan moves it in its limits.
ROLLED_OUT = 10.0
MU_WARM, MU_MOST = 1e-4, 0.1  # barrier parameter of a remembered plan, and how far it is raised, in units of the cost
# Where pure steps are tried first, and last: at the last one limits whose multipliers nearly vanish are 1e-7 of a unit away.
MU_END, MU_LEAST = 1e-5, 1e-15
MU_ROUNDS = 8  # reductions after one accepted plan
FILTER = 64  # pairs that the filter holds
SURE = 1e-9  # of the summands: how far a sum must be above zero to be no rounding
POOR = 0.1  # share of a step from a remembered plan below which its barrier is raised, at most so often in a call
MOST_REWARMS = 3
MOST_RAISES = 12  # of the Levenberg-Marquardt term before another first plan is tried
ROUNDING = 1e-12  # of the cost: smaller differences are rounding
LEAST_DAMPING = 1e-7  # of the Levenberg-Marquardt term of descents, and of the fall that a plan of theirs must bring
# The price of gaps of a descent, in units of the largest costate: at least, and where it must rise.
NEARLY, ABOVE = 1.1, 2.0
ROLLED, REFERENCE = 1, 2  # first plans after the state held: the inputs rolled out, and the reference
DESCENT, LAST_START = 3, 4  # and for descents, where all of these failed: the reference, and the state held


@dataclass(frozen=True)
class LimitedSettings:
    """Settings of one Function."""

    tolerance: float  # of the stationarity, in the unit of the inputs
    feasible: float  # violation of a state bound, as a share of its unit, below which a call may end
    map: Deformation  # the deformation of pure steps
    hessian: HessianModel | None  # second derivatives of the quadratic model; None: exact
    damping: float  # added to the curvature of the inputs, in units of it
    iterations: int  # most iterations of one call

    @property
    def plain_first(self) -> bool:
        """Whether a remembered plan is improved by Gauss-Newton before the exact Hessian is computed."""
        return self.hessian is None

    def scaled_tolerance(self, scales: Scales) -> float:
        """Return the tolerance in units of the inputs' half ranges."""
        return float(max(self.tolerance / scales.inputs.min(), 1e-12))


def limited_memory(ocp: OptimalControl) -> Layout:
    """Return the layout of the plan, its states and costates s_1 ... s_N, its feedback, its multipliers, mu and the damping.

    `plan_barrier` is zero where no plan is remembered.
    """
    n, states, inputs = range(ocp.stages), ocp.state.elements, ocp.input.elements
    rows = (*inputs, *(states[k] for k in scales(ocp).bounded))
    later = tuple(f"{e}@{k + 1}" for k in n for e in states)
    multipliers = tuple(f"{side} {e}@{k}" for side in ("lower", "upper") for k in n for e in rows)
    return Layout(
        (
            Signal("plan_inputs", tuple(f"{e}@{k}" for k in n for e in inputs)),
            Signal("plan_states", later),
            Signal("plan_costates", later),
            Signal("plan_gains", tuple(f"{e}/{x}@{k}" for k in n for x in states for e in inputs)),
            Signal("plan_multipliers", multipliers),
            discrete("plan_barrier"),
            discrete("plan_damping"),
        )
    )
