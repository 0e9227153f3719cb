"""Settings of the plain iteration, for the loops in C and for the composed graph."""

from __future__ import annotations

from dataclasses import dataclass

from fpirhc.deformation.base import Deformation
from fpirhc.horizon.hessian_models import HessianModel
from fpirhc.horizon.problem import OptimalControl
from fpirhc.symbolic.layout import Layout, Signal, scalar
from fpirhc.symbolic.live import Number

MOST = 100  # iterations of one converging call
MOST_PLAIN = 30  # plain steps after which a converging call gives up


@dataclass(frozen=True)
class PlainSettings:
    """Settings of one Function.

    Args:
        tolerance: of the stationarity, in the unit of the inputs.
        map: the deformation that makes the next plan.
        hessian: second derivatives of the quadratic model.
        damping: added to the curvature of the inputs, in units of it.
        iterations: most iterations of one call.
        converging: whether a call stops where the tolerance is met.
    """

    tolerance: Number
    map: Deformation
    hessian: HessianModel
    damping: Number
    iterations: int
    converging: bool


def plain_memory(ocp: OptimalControl) -> Layout:
    """Return the layout of the plan, its states and feedback, and the line search's step lengths."""
    n, state, inputs = ocp.stages, ocp.state.elements, ocp.input.elements
    return Layout(
        (
            Signal("plan_inputs", tuple(f"{i}@{k}" for k in range(n) for i in inputs)),
            Signal("plan_states", tuple(f"{s}@{k}" for k in range(n) for s in state)),
            Signal("plan_gains", tuple(f"{i}/{s}@{k}" for k in range(n) for s in state for i in inputs)),
            scalar("plan_gamma", start=0.0),
            scalar("plan_step", start=0.0),
        )
    )
