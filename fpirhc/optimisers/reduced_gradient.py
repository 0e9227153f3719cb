"""The reduced-gradient method, which the fixed-point optimisers replace. Theory: docs/theory.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import casadi as ca

from fpirhc.fields.kinds import Count, Positive
from fpirhc.horizon.problem import OptimalControl, reduced_gradient
from fpirhc.optimisers.base import Optimiser, call_arguments, clip, judged_plan, remembered_plan, shift
from fpirhc.symbolic.expression import TINY, is_finite
from fpirhc.symbolic.layout import Layout, Signal, discrete

_HISTORY = 5  # values that the non-monotone line search compares with
_DECREASE = 1e-4
_SHORTER = 0.25  # factor of the step length after a rejected step
_SHORTEST, _LONGEST = 1e-6, 1e6  # bounds of the spectral step length
_FIRST = 0.25  # below 1, because inputs of neighbouring stages add up


@dataclass(frozen=True)
class ReducedGradient(Optimiser):
    """Projected spectral gradient with a fixed number of iterations per call.

    Args:
        iterations: per call.
        tolerance: of the stationarity, in the unit of the inputs, below which a plan is converged.
    """

    cannot_keep = ("states",)

    iterations: Count
    tolerance: Positive

    def memory(self, ocp: OptimalControl) -> Layout:
        plan = Signal("plan_inputs", tuple(f"{i}@{k}" for k in range(ocp.stages) for i in ocp.input.elements))
        return Layout((plan, discrete("plan_step_length")))

    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        plan = ca.reshape(memory[:-1], ocp.input.size, ocp.stages)
        return ca.vertcat(ca.vec(shift(plan, ocp)), memory[-1])

    def step(self, ocp: OptimalControl) -> ca.Function:
        nu, n = ocp.input.size, ocp.stages
        s0, data, lower, upper, memory = arguments = call_arguments(ocp, nu * n + 1)
        start = remembered_plan(memory[: nu * n], nu, lower, upper)
        none = ca.MX.zeros(ocp.state.size, n)
        value, slope, _, _ = reduced_gradient(ocp)(s0, start, data, none)
        known = ca.logic_and(memory[-1] >= _SHORTEST, memory[-1] <= _LONGEST)
        length = ca.if_else(known, memory[-1], _FIRST)
        begin = (start, ca.repmat(value, _HISTORY, 1), length, start, value, slope)
        state = ca.vertcat(*(ca.vec(v) for v in begin))
        iterate = self._iteration(ocp).fold(self.iterations)
        repeated = [ca.repmat(v, 1, self.iterations) for v in (s0, ca.vec(data), lower, upper)]
        final = iterate(state, *repeated)
        best, length = ca.reshape(_part(ocp, final, 3), nu, n), _part(ocp, final, 2)
        survives = is_finite(ca.vertcat(value, ca.vec(slope)))
        finite, posed, diagnostics = judged_plan(ocp, arguments, best, (self.iterations, self.tolerance))
        plan = ca.if_else(finite, best, start)
        # A remembered plan under which a well-posed problem overflows is given up, so that the next call can succeed.
        lost = ca.logic_and(posed, ca.logic_not(ca.logic_or(finite, survives)))
        next_inputs = ca.if_else(lost, clip(0 * plan, lower, upper), plan)
        next_memory = ca.vertcat(ca.vec(next_inputs), ca.if_else(finite, length, 0))
        return ca.Function("fpirhc_reduced_gradient", arguments, [plan, diagnostics, next_memory])

    def _iteration(self, ocp: OptimalControl) -> ca.Function:
        """One iteration on the column (U, last values, step length, best U, best value, gradient at U)."""
        nu, n = ocp.input.size, ocp.stages
        state = ca.MX.sym("z", 3 * nu * n + _HISTORY + 2)
        s0, flat = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size * (n + 1))
        lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
        data = ca.reshape(flat, ocp.data.size, n + 1)
        inputs, slope = (ca.reshape(_part(ocp, state, k), nu, n) for k in (0, 5))
        values, length = _part(ocp, state, 1), _part(ocp, state, 2)
        best, lowest = ca.reshape(_part(ocp, state, 3), nu, n), _part(ocp, state, 4)
        scale = cast(ca.MX, ca.repmat(ca.DM(ocp.scale), 1, n))
        next_inputs = clip(inputs - length * scale * slope, lower, upper)
        move = next_inputs - inputs
        value, new_slope, _, _ = reduced_gradient(ocp)(s0, next_inputs, data, ca.MX.zeros(ocp.state.size, n))
        # NaN compares false, so a rollout that overflows is rejected like one that does not decrease enough.
        enough = value <= ca.mmax(values) + _DECREASE * ca.dot(slope, move)
        accepted = ca.logic_and(enough, is_finite(ca.vertcat(value, ca.vec(new_slope))))
        spectral = _spectral_length(move, scale, new_slope - slope, length)
        better = ca.logic_and(accepted, value <= lowest)
        result = ca.vertcat(
            ca.vec(ca.if_else(accepted, next_inputs, inputs)),
            ca.if_else(accepted, ca.vertcat(values[1:], value), values),
            ca.if_else(accepted, spectral, _SHORTER * length),
            ca.vec(ca.if_else(better, next_inputs, best)),
            ca.if_else(better, value, lowest),
            ca.vec(ca.if_else(accepted, new_slope, slope)),
        )
        return ca.Function("fpirhc_gradient_iteration", [state, s0, flat, lower, upper], [result])


def _part(ocp: OptimalControl, state: ca.MX, k: int) -> ca.MX:
    size = ocp.input.size * ocp.stages
    ends = [0]
    for width in (size, _HISTORY, 1, size, 1, size):
        ends.append(ends[-1] + width)
    return state[ends[k] : ends[k + 1]]


def _spectral_length(move: ca.MX, scale: ca.MX, change: ca.MX, before: ca.MX) -> ca.MX:
    """Barzilai-Borwein: <move, move / D> / <move, change>, kept where the curvature is not positive."""
    curvature, size = ca.dot(move, change), ca.dot(move, move / scale)
    usable = ca.logic_and(curvature > TINY, size > TINY)
    length = size / ca.if_else(usable, curvature, 1)
    return ca.if_else(usable, ca.fmin(ca.fmax(length, _SHORTEST), _LONGEST), before)


EXAMPLES = (ReducedGradient(iterations=200, tolerance=1e-6),)
CHOICES = {
    "reduced-gradient": ("reduced gradient", lambda tolerance: ReducedGradient(iterations=50, tolerance=tolerance))
}
