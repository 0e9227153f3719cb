"""The published optimisers, to compare `FixedPointSolver` with: two fixed-point iterations, and the gradient method they replace.

    FullSpaceFixedPoint     z = (S, U, mu),   g = grad Psi(z),   H = Hessian of Psi (the KKT matrix),   h = H'g,   z+ = G(z, h, 0)
    GradientFixedPoint      U+ = clip(G(U, h, 0)),   h = D g,   D = 1/(step c)
    ReducedGradient         projected spectral gradient

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import casadi as ca
import numpy as np

from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import require_map_of_plan
from fpirhc.errors import NotContractive
from fpirhc.fields.kinds import Count, Positive
from fpirhc.horizon.problem import OptimalControl, reduced_gradient, rollout, steepest_curvature
from fpirhc.optimisers import Optimiser, call_arguments, clip, judged_plan, refuse_limits, remembered_plan, shift
from fpirhc.symbolic.expression import TINY, expression, graph, is_finite
from fpirhc.symbolic.layout import Layout, Signal, scalar

_SAFE = 0.95  # share of the largest gain, for the map that is chosen automatically
_BALANCING = 20  # passes of Ruiz's equilibration
_HISTORY = 5  # values that the non-monotone line search compares with
_DECREASE = 1e-4
_SHORTER = 0.25  # factor of the step length after a rejected step
_SHORTEST, _LONGEST = 1e-6, 1e6  # bounds of the spectral step length
_FIRST = 0.25  # below 1, because inputs of neighbouring stages add up


def _plan(ocp: OptimalControl) -> Signal:
    return Signal("plan_inputs", tuple(f"{i}@{k}" for k in range(ocp.stages) for i in ocp.input.elements))


def _require_gain(name: str, map: Deformation, largest: float) -> None:
    """Raise unless the map's gain is inside (0, largest), in which the iteration contracts along the reference."""
    require_map_of_plan(name, map)
    gain = max(map.secant_gain(), map.effective_gain(), key=abs)
    if not 0 < gain < largest:
        raise NotContractive(
            f"{name}: the map's gain {gain:.3g} is outside (0, {largest:.3g}), the interval in which the iteration contracts along "
            f"the reference; use map.with_effective_gain({0.5 * largest:.3g})"
        )


@dataclass(frozen=True)
class FullSpaceFixedPoint(Optimiser):
    """The faithful baseline: map (6) on z = (S, U, mu) with h = H'g.

    Args:
        iterations: per call; 10^4 and more are usual.
        tolerance: of the stationarity, in the unit of the inputs.
        map: the deformation; None chooses the affine map with 0.95 of the gain 1/sigma_max(H)^2 along the reference.
        scaled: iterate on variables that make the rows of H of the same size (Ruiz), which helps by orders of magnitude.
    """

    iterations: Count
    tolerance: Positive
    map: Deformation | None = None
    scaled: bool = False

    def check(self, ocp: OptimalControl) -> None:
        """Raise if anything is bounded, or the map's gain cannot contract.

        Raises:
            NotSupported: some input or state has limits.
            NotContractive: a gain outside (0, 2 / sigma_max(H)^2).
        """
        refuse_limits(self, ocp, "inputs")
        if self.map is not None:
            _require_gain("FullSpaceFixedPoint", self.map, 2 / _scaling(ocp, self.scaled)[1] ** 2)

    def memory(self, ocp: OptimalControl) -> Layout:
        n = ocp.stages
        states = tuple(f"{s}@{k}" for k in range(1, n + 1) for s in ocp.state.elements)
        return Layout((Signal("plan_states", states), _plan(ocp), Signal("plan_multipliers", states)))

    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        rows = {"plan_states": ocp.state.size, "plan_inputs": ocp.input.size, "plan_multipliers": ocp.state.size}
        parts = self.memory(ocp).split(memory)
        return self.memory(ocp).join(
            {k: ca.vec(shift(ca.reshape(v, rows[k], ocp.stages), ocp)) for k, v in parts.items()}
        )

    def step(self, ocp: OptimalControl) -> ca.Function:
        nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
        s0, data, _, _, memory = arguments = call_arguments(ocp, n * (2 * ns + nu))
        remembered_parts = self.memory(ocp).split(ca.if_else(is_finite(memory), memory, 0))
        fresh = ca.logic_not(ca.mmax(ca.fabs(remembered_parts["plan_states"])) > 0)
        rolled = rollout(ocp)(s0, ca.reshape(remembered_parts["plan_inputs"], nu, n), data)[0]
        guess = ca.if_else(is_finite(rolled), rolled[:, 1:], ca.repmat(s0, 1, n))
        states = ca.if_else(fresh, ca.vec(guess), remembered_parts["plan_states"])
        start = ca.vertcat(states, remembered_parts["plan_inputs"], remembered_parts["plan_multipliers"])
        scale = ca.DM(_scaling(ocp, self.scaled)[0])
        repeated = self._transformation(ocp).fold(self.iterations)
        last = scale * repeated(ca.vertcat(start / scale, s0, ca.vec(data)))[: start.numel()]
        plan = ca.reshape(last[n * ns : n * (ns + nu)], nu, n)
        finite, posed, diagnostics = judged_plan(ocp, arguments, plan, (self.iterations, self.tolerance), last)
        before = ca.reshape(remembered_parts["plan_inputs"], nu, n)
        remembered = ca.if_else(finite, last, ca.if_else(posed, 0, memory))
        results = [ca.if_else(finite, plan, before), diagnostics, remembered]
        return ca.Function("fpirhc_full_space", arguments, results)

    def _transformation(self, ocp: OptimalControl) -> ca.Function:
        """Function of the column (scaled z, s0, data), of which z goes on."""
        nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
        column, flat = ca.MX.sym("z", n * (2 * ns + nu)), ca.MX.sym("data", ocp.data.size * (n + 1))
        s0, data = ca.MX.sym("s0", ns), ca.reshape(flat, ocp.data.size, n + 1)
        factors, largest = _scaling(ocp, self.scaled)
        scale = ca.DM(factors)
        states, inputs, multipliers = ca.vertsplit(scale * column, [0, n * ns, n * (ns + nu), column.numel()])
        shaped = ca.reshape(states, ns, n), ca.reshape(inputs, nu, n), ca.reshape(multipliers, ns, n)
        slope = scale * ca.vertcat(*(ca.vec(v) for v in auxiliary_gradient(ocp)(*shaped, s0, data)))
        response = ca.jtimes(slope, column, slope, True)
        map_in_use = Affine(gain=-2 * _SAFE / largest**2) if self.map is None else self.map
        request, error, none = (expression(v) for v in (column, response, ca.MX.zeros(column.numel())))
        next_column, _ = map_in_use.step(request, error, none, {})
        one = ca.Function("fpirhc_transformed_auxiliary", [column, s0, flat], [graph(next_column)])
        given = ca.MX.sym("given", column.numel() + ns + flat.numel())
        parts = ca.vertsplit(given, [0, column.numel(), column.numel() + ns, given.numel()])
        return ca.Function("fpirhc_auxiliary_iteration", [given], [ca.vertcat(one(*parts), *parts[1:])])


def _scaling(ocp: OptimalControl, scaled: bool) -> tuple[np.ndarray, float]:
    """Factors W of the variables, and the largest singular value of W H W along the reference."""
    states, inputs, data = ocp.nodes
    none = np.zeros((ocp.state.size, ocp.stages))
    hessian = np.asarray(auxiliary_hessian(ocp)(states[:, 1:], inputs, none, states[:, 0], data).full())
    factors = np.ones(hessian.shape[0])
    for _ in range(_BALANCING if scaled else 0):
        size = np.abs(factors[:, None] * hessian * factors).max(axis=1)
        factors /= np.sqrt(np.where(size > 0, size, 1.0))
    largest = float(np.abs(np.linalg.eigvalsh(factors[:, None] * hessian * factors)).max())
    return factors, largest


def _auxiliary(ocp: OptimalControl) -> ca.Function:
    """Function (S (ns, N), U (nu, N), mu (ns, N), s0, data) -> Psi."""
    n = ocp.stages
    states, inputs = ca.MX.sym("S", ocp.state.size, n), ca.MX.sym("U", ocp.input.size, n)
    multipliers = ca.MX.sym("mu", ocp.state.size, n)
    s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, n + 1)
    before = ca.horzcat(s0, states[:, : n - 1])
    next_states = ocp.dynamics.map(n)(before, inputs, data[:, :n])
    costs, _ = ocp.stage_cost.map(n)(before, inputs, data[:, :n])
    value = ca.sum2(costs) + ocp.terminal_cost(states[:, n - 1], data[:, n])
    value += ca.dot(multipliers, states - next_states)
    names = ["S", "U", "mu", "s0", "data"]
    return ca.Function("fpirhc_auxiliary", [states, inputs, multipliers, s0, data], [value], names, ["psi"])


def auxiliary_gradient(ocp: OptimalControl) -> ca.Function:
    """Function (S, U, mu, s0, data) -> gradients of Psi with respect to S, U and mu, shaped like them."""
    psi = _auxiliary(ocp)
    symbols = [ca.MX.sym(psi.name_in(k), *psi.size_in(k)) for k in range(psi.n_in())]
    value = psi(*symbols)
    gradients = [ca.gradient(value, v) for v in symbols[:3]]
    return ca.Function("fpirhc_auxiliary_gradient", symbols, gradients, psi.name_in(), ["dS", "dU", "dmu"])


def auxiliary_hessian(ocp: OptimalControl) -> ca.Function:
    """Function (S, U, mu, s0, data) -> Hessian of Psi with respect to z = (vec S, vec U, vec mu), symmetric."""
    n, ns, nu = ocp.stages, ocp.state.size, ocp.input.size
    z = ca.MX.sym("z", n * (2 * ns + nu))
    s0, data = ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
    states, inputs, multipliers = ca.vertsplit(z, [0, n * ns, n * (ns + nu), n * (2 * ns + nu)])
    shaped = (ca.reshape(states, ns, n), ca.reshape(inputs, nu, n), ca.reshape(multipliers, ns, n))
    hessian, _ = ca.hessian(_auxiliary(ocp)(*shaped, s0, data), z)
    flat = ca.Function("fpirhc_hessian", [z, s0, data], [hessian])
    arguments = [ca.MX.sym(name, rows, n) for name, rows in (("S", ns), ("U", nu), ("mu", ns))]
    packed = ca.vertcat(*(ca.vec(v) for v in arguments))
    return ca.Function("fpirhc_auxiliary_hessian", [*arguments, s0, data], [flat(packed, s0, data)])


@dataclass(frozen=True)
class GradientFixedPoint(Optimiser):
    """Fixed-point iteration with the scaled reduced gradient as its response error.

    Args:
        iterations: per call.
        tolerance: of the stationarity, in the unit of the inputs.
        map: the deformation; None chooses the affine map with 0.95 of the gain 1/L, L the largest curvature along the reference.
    """

    iterations: Count
    tolerance: Positive
    map: Deformation | None = None

    def check(self, ocp: OptimalControl) -> None:
        """Raise if states are bounded, or the map's gain cannot contract.

        Raises:
            NotSupported: projection keeps bounds of inputs only.
            NotContractive: a gain outside (0, 2 / L).
        """
        refuse_limits(self, ocp, "states")
        _require_gain("GradientFixedPoint", self._map(ocp), 2 / _steepest(ocp))

    def memory(self, ocp: OptimalControl) -> Layout:
        return Layout((_plan(ocp),))

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


@dataclass(frozen=True)
class ReducedGradient(Optimiser):
    """Projected spectral gradient with a fixed number of iterations per call.

    Args:
        iterations: per call.
        tolerance: of the stationarity, in the unit of the inputs, below which a plan is converged.
    """

    iterations: Count
    tolerance: Positive

    def check(self, ocp: OptimalControl) -> None:
        """Raise if states are bounded: projection keeps bounds of inputs only."""
        refuse_limits(self, ocp, "states")

    def memory(self, ocp: OptimalControl) -> Layout:
        return Layout((_plan(ocp), scalar("plan_step_length")))

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
    ends = np.cumsum([0, size, _HISTORY, 1, size, 1, size]).tolist()
    return state[ends[k] : ends[k + 1]]


def _spectral_length(move: ca.MX, scale: ca.MX, change: ca.MX, before: ca.MX) -> ca.MX:
    """Barzilai-Borwein: <move, move / D> / <move, change>, kept where the curvature is not positive."""
    curvature, size = ca.dot(move, change), ca.dot(move, move / scale)
    usable = ca.logic_and(curvature > TINY, size > TINY)
    length = size / ca.if_else(usable, curvature, 1)
    return ca.if_else(usable, ca.fmin(ca.fmax(length, _SHORTEST), _LONGEST), before)


EXAMPLES = (
    FullSpaceFixedPoint(iterations=3000, tolerance=1e-6, scaled=True),
    GradientFixedPoint(iterations=100, tolerance=1e-6),
    ReducedGradient(iterations=200, tolerance=1e-6),
)
