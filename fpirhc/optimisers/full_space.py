"""The published fixed-point optimiser: states, inputs and multipliers together, the gradient of the auxiliary function to zero.

    z = (S, U, mu),   g = grad Psi(z),   H = Hessian of Psi (the KKT matrix),   h = H'g,   z+ = G(z, h, 0)

It is the baseline to which `GradientFixedPoint` and `FixedPoint` are compared (docs/theory.md); it serves no limits.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import require_map_of_plan
from fpirhc.errors import NotContractive
from fpirhc.fields.kinds import Count, Positive
from fpirhc.horizon.problem import OptimalControl, rollout
from fpirhc.optimisers.base import Optimiser, call_arguments, judged_plan, shift
from fpirhc.symbolic.expression import expression, graph, is_finite
from fpirhc.symbolic.layout import Layout, Signal

_SAFE = 0.95
_BALANCING = 20  # passes of Ruiz's equilibration


@dataclass(frozen=True)
class FullSpaceFixedPoint(Optimiser):
    """The faithful baseline: map (6) on z = (S, U, mu) with h = H'g.

    Args:
        iterations: per call; 10^4 and more are usual.
        tolerance: of the stationarity, in the unit of the inputs.
        map: the deformation; None chooses the affine map with 0.95 of the gain 1/sigma_max(H)^2 along the reference.
        scaled: iterate on variables that make the rows of H of the same size (Ruiz), which helps by orders of magnitude.
    """

    cannot_keep = ("inputs",)

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
        super().check(ocp)
        if self.map is not None:
            require_map_of_plan("FullSpaceFixedPoint", self.map)
            largest = 2 / _scaling(ocp, self.scaled)[1] ** 2
            gain = max(self.map.secant_gain(), self.map.effective_gain(), key=abs)
            if not 0 < gain < largest:
                raise NotContractive(
                    f"FullSpaceFixedPoint: the map's gain {gain:.3g} is outside (0, {largest:.3g}); "
                    f"use map.with_effective_gain({0.5 * largest:.3g})"
                )

    def memory(self, ocp: OptimalControl) -> Layout:
        n = ocp.stages
        states = tuple(f"{s}@{k}" for k in range(1, n + 1) for s in ocp.state.elements)
        plan = tuple(f"{i}@{k}" for k in range(n) for i in ocp.input.elements)
        return Layout((Signal("plan_states", states), Signal("plan_inputs", plan), Signal("plan_multipliers", states)))

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


EXAMPLES = (FullSpaceFixedPoint(iterations=3000, tolerance=1e-6, scaled=True),)


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
