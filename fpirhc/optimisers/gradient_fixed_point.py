"""Fixed-point iteration on the reduced gradient itself, without a preconditioner.

    U+ = clip(G(U, h, 0)),     h = D g,     D = 1/(step c),

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import require_map_of_plan
from fpirhc.errors import NotContractive
from fpirhc.fields.kinds import Count, Positive
from fpirhc.horizon.problem import OptimalControl, reduced_gradient, steepest_curvature
from fpirhc.optimisers.base import Optimiser, call_arguments, clip, judged_plan, remembered_plan, shift
from fpirhc.symbolic.expression import expression, graph
from fpirhc.symbolic.layout import Layout, Signal

_SAFE = 0.95  # share of the largest gain, for the map that is chosen automatically


@dataclass(frozen=True)
class GradientFixedPoint(Optimiser):
    """Fixed-point iteration with the scaled reduced gradient as its response error.

    Args:
        iterations: per call.
        tolerance: of the stationarity, in the unit of the inputs.
        map: the deformation; None chooses the affine map with 0.95 of the gain 1/L, L the largest curvature along the reference.
    """

    cannot_keep = ("states",)

    iterations: Count
    tolerance: Positive
    map: Deformation | None = None

    def check(self, ocp: OptimalControl) -> None:
        """Raise if states are bounded, or the map's gain cannot contract.

        Raises:
            NotSupported: projection keeps bounds of inputs only.
            NotContractive: a gain outside (0, 2 / L).
        """
        super().check(ocp)
        largest = 2 / _steepest(ocp)
        map_in_use = self._map(ocp)
        require_map_of_plan("GradientFixedPoint", map_in_use)
        gain = max(map_in_use.secant_gain(), map_in_use.effective_gain(), key=abs)
        if not 0 < gain < largest:
            raise NotContractive(
                f"GradientFixedPoint: the map's gain {gain:.3g} is outside (0, {largest:.3g}), the interval in which the "
                f"iteration contracts along the reference; use map.with_effective_gain({0.5 * largest:.3g})"
            )

    def memory(self, ocp: OptimalControl) -> Layout:
        return Layout(
            (Signal("plan_inputs", tuple(f"{i}@{k}" for k in range(ocp.stages) for i in ocp.input.elements)),)
        )

    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        return ca.vec(shift(ca.reshape(memory, ocp.input.size, ocp.stages), ocp))

    def step(self, ocp: OptimalControl) -> ca.Function:
        nu, n = ocp.input.size, ocp.stages
        s0, data, lower, upper, memory = arguments = call_arguments(ocp, nu * n)
        start = remembered_plan(memory, nu, lower, upper)
        transformed, column = self._transformation(ocp), ca.vec(start)
        for _ in range(self.iterations):
            column = transformed(column, s0, data, lower, upper)
        inputs = clip(ca.reshape(column, nu, n), lower, upper)
        finite, posed, diagnostics = judged_plan(ocp, arguments, inputs, (self.iterations, self.tolerance))
        plan = ca.if_else(finite, inputs, start)
        # A remembered plan under which a well-posed problem overflows is given up, so that the next call can succeed.
        next_memory = ca.if_else(finite, ca.vec(plan), ca.if_else(posed, 0, memory))
        return ca.Function("fpirhc_gradient_fixed_point", arguments, [plan, diagnostics, next_memory])

    def _map(self, ocp: OptimalControl) -> Deformation:
        return Affine(gain=-2 * _SAFE / _steepest(ocp)) if self.map is None else self.map

    def _transformation(self, ocp: OptimalControl) -> ca.Function:
        """Function (column U, s0, data, lower, upper) -> column U+."""
        nu, n = ocp.input.size, ocp.stages
        column = ca.MX.sym("U", nu * n)
        s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, n + 1)
        lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
        inputs = ca.reshape(column, nu, n)
        slope = reduced_gradient(ocp)(s0, inputs, data, ca.MX.zeros(ocp.state.size, n))[1]
        response = ca.vec(ca.repmat(ca.DM(ocp.scale), 1, n) * slope)
        request, error, none = (expression(v) for v in (column, response, ca.MX.zeros(nu * n)))
        next_column, _ = self._map(ocp).step(request, error, none, {})
        clipped = ca.vec(clip(ca.reshape(graph(next_column), nu, n), lower, upper))
        return ca.Function("fpirhc_transformed_plan", [column, s0, data, lower, upper], [clipped])


def _steepest(ocp: OptimalControl) -> float:
    return steepest_curvature(ocp.along, ocp.scale)


EXAMPLES = (GradientFixedPoint(iterations=100, tolerance=1e-6),)
