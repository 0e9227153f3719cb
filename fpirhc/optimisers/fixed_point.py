"""Fixed-point iteration on the reduced gradient, preconditioned by one Riccati sweep: the default optimiser.

The gradient of the auxiliary function vanishes where the reduced gradient g(U) does. The iteration asks for g = 0 and deforms the
plan as a control loop deforms its request,

    U+ = G(U, h, 0),     h = M^-1 g,

with any deformation map G and M the (Gauss-Newton) Hessian of V, never formed: one backward sweep (`fpirhc.horizon.riccati`) gives
a feedforward v = -h and a feedback K, and the new plan is rolled out with them,

    u_i = clip(U_i + [G(U, -v, 0) - U]_i + K_i (x_i - X_i)),

which keeps unstable models together. The contraction factor is |1 - a eig(M^-1 V'')|, a few hundredths where M is close to V''.

Globalisation (Stella, Themelis, Sopasakis, Patrinos: PANOC, IEEE CDC 2017). With T = clip(U - gamma D g) the plain fixed-point
step and gamma < 1 / L, a new plan must decrease the forward-backward envelope

    phi(U) = V + g'(T - U) + 1/(2 gamma) |T - U|^2

by a share of |T - U|^2 (a short step: V by a share of what it promises), and raise neither phi nor V; else the step is shortened,
and at last T itself is taken, which always decreases phi. T is tested for the quadratic upper bound that gamma promises; where
it fails gamma is shortened, at least to its half. D = 1/(step c) is the scale of `OptimalControl`.

A call evaluates the remembered plan, rolled out with its remembered feedback, which answers to first order for a new initial
state; an iteration finds a direction by one Riccati sweep and evaluates the plan there: one rollout with Jacobians and one
adjoint sweep, whatever happens. So every plan that is returned has been evaluated.

With limits of states the iteration is that of `fpirhc.optimisers.limited`: the same step with the active limits as equalities, and
interior steps where it does not contract. An open-loop solve without limits of states falls back on it too.

References: H. Khan, J. K. Tar, I. J. Rudas on fixed-point iteration in place of the reduced gradient (2017-2018); H. Issa,
J. K. Tar, Electronics 11, 1243, 2022, for the transition between gradient descent and Newton (`damping`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import resources

import casadi as ca
import numpy as np

from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import require_own_requests
from fpirhc.errors import InvalidValue, NotSupported
from fpirhc.fields.kinds import Count
from fpirhc.horizon.hessian_models import GaussNewton, HessianModel, hessian_end, hessian_stage, linear_stage
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.riccati import PIVOT, rounds
from fpirhc.optimisers.base import (
    FINITE,
    Optimiser,
    clip,
    is_finite,
    require_settings,
    sane,
    shift,
    stationarity,
    status_of,
)
from fpirhc.optimisers.improved import improved
from fpirhc.optimisers.limited import limited_step, shifted_limited
from fpirhc.optimisers.limited_memory import limited_memory
from fpirhc.optimisers.limited_settings import LimitedSettings
from fpirhc.optimisers.rescue import rescue
from fpirhc.optimisers.search import (
    ARMIJO,
    DRAWN_IN,
    ROUNDING,
    SHARE,
    SHORTER,
    SHORTEST,
    UNTRIED,
    Anchor,
    Given,
    Search,
    deformed_move,
    first_gamma,
)
from fpirhc.status import Status
from fpirhc.symbolic.driver import Driver, with_driver
from fpirhc.symbolic.layout import Layout, Signal, scalar

_DIGITS = 1e-15  # relative rounding of a number
MOST = 100  # iterations of one converging call
_MOST_LIMITED = 300
_PLAIN = 30  # plain steps after which a converging call without limits of states gives up
_FIRST_CALLS = 5  # of `converging`, before a run
_CONVEX = 1e-6  # relative eigenvalue below zero that is taken for rounding


@dataclass(frozen=True)
class FixedPoint(Optimiser):
    """Fixed-point iteration in place of the reduced gradient.

    Parameters:
        iterations: per call; 1 is the spirit of the method, one step per control cycle.
        tolerance: of the stationarity (in the unit of the inputs), below which a plan is converged.
        feasible: violation of a state bound (in its unit) below which a plan counts as converged.
        map: the deformation that makes the next plan; Affine(gain=-2.0) is the full step, a Sigmoid's scale limits it.
        hessian: GaussNewton() or ExactHessian(); None is Gauss-Newton without limits of states and the exact Hessian with them.
        damping: mu >= 0 added to the input's curvature, in units of it: 0 is Gauss-Newton, large values are gradient descent.

    Raises:
        InvalidValue: fewer than one iteration, a tolerance that is not positive, or a negative damping.
    """

    iterations: Count
    tolerance: float
    map: Deformation = field(default_factory=lambda: Affine(gain=-2.0))
    hessian: HessianModel | None = None
    damping: float = 0.0
    feasible: float = 1e-8

    def __post_init__(self) -> None:
        require_settings("FixedPoint", self.iterations, self.tolerance)
        if not 0 <= self.damping < float("inf"):
            raise InvalidValue(f"FixedPoint(damping={self.damping!r}): expected a finite number of at least 0")

    def check(self, ocp: OptimalControl) -> None:
        """Raise if the cost is not convex along the reference, or the tolerance cannot be met.

        Raises:
            NotSupported: a quadratic model of such a cost has no minimum; a model-referenced map.
            InvalidValue: a tolerance below the rounding of inputs.
        """
        require_own_requests("FixedPoint", self.map)
        reach = np.abs(np.concatenate([ocp.input_lower, ocp.input_upper, ocp.nodes[1].ravel()]))
        rounding = _DIGITS * float(reach[np.isfinite(reach)].max(initial=0.0))
        if self.tolerance < rounding:
            raise InvalidValue(
                f"FixedPoint(tolerance={self.tolerance:g}): inputs of this size are rounded to {rounding:.1g}; "
                f"use {1e3 * rounding:.0g}"
            )
        least = ocp.along.least_bend()
        if least < -_CONVEX:
            raise NotSupported(
                f"FixedPoint needs a cost that bends upwards; along the reference the stage or terminal cost has an eigenvalue of "
                f"{least:.2g} times its largest. Use ReducedGradient() or Ipopt(), or add a convex term to the cost"
            )

    def memory(self, ocp: OptimalControl) -> Layout:
        """The plan, its states and feedback, and the line search's step lengths; or what limits of states need."""
        if ocp.bounds_states:
            return limited_memory(ocp)
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

    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        """The memory one stage later; the last stage, which is repeated, has no feedback."""
        if ocp.bounds_states:
            return shifted_limited(ocp, memory)
        kept = self.memory(ocp).split(memory)
        ns, nu, n = ocp.state.size, ocp.input.size, ocp.stages
        gains = ca.vertcat(kept["plan_gains"][nu * ns :], ca.MX.zeros(nu * ns))
        moved = {
            "plan_inputs": ca.vec(shift(ca.reshape(kept["plan_inputs"], nu, n))),
            "plan_states": ca.vec(shift(ca.reshape(kept["plan_states"], ns, n))),
            "plan_gains": gains,
        }
        return self.memory(ocp).join({**kept, **moved})

    def step(self, ocp: OptimalControl) -> ca.Function:
        """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory).

        Every call does the same `iterations`; as C it runs as the loops of fixed_point.c.
        """
        if ocp.bounds_states:
            return limited_step(ocp, self._limited(self.iterations, realtime=True))
        driver = self._driver(ocp, iterations=self.iterations, stop_early=0)
        return with_driver("fpirhc_fixed_point", driver, lambda name: self._graph(ocp, name))

    def converging(self, ocp: OptimalControl) -> ca.Function:
        """The same, but stops where the tolerance is met, or where the iteration does not contract."""
        if ocp.bounds_states:
            return limited_step(ocp, self._limited(_MOST_LIMITED, realtime=False))
        driver = self._driver(ocp, iterations=MOST, stop_early=1)
        return with_driver("fpirhc_fixed_point_converging", driver, lambda name: self._converging_graph(ocp, name))

    def rescue(self, ocp: OptimalControl) -> ca.Function | None:
        """Interior steps for a plan without limits of states that did not converge."""
        if ocp.bounds_states:
            return None
        limited = limited_step(ocp, self._limited(_MOST_LIMITED, realtime=False))
        return rescue(ocp, self.converging(ocp), self.memory(ocp), limited)

    def first_memory(self, ocp: OptimalControl, state: np.ndarray, data: np.ndarray) -> np.ndarray:
        """The memory after solving the first horizon to the tolerance, as far as that succeeds."""
        memory = improved(self, ocp, state, data, self.memory(ocp).start(), calls=_FIRST_CALLS)[2]
        return memory if np.isfinite(memory).all() else self.memory(ocp).start()

    def _limited(self, iterations: int, *, realtime: bool) -> LimitedSettings:
        return LimitedSettings(
            self.tolerance,
            self.feasible,
            self.map,
            self.hessian,
            self.damping,
            iterations=iterations,
            realtime=realtime,
        )

    @property
    def _plain_hessian(self) -> HessianModel:
        return self.hessian or GaussNewton()

    def _driver(self, ocp: OptimalControl, *, iterations: int, stop_early: int) -> Driver:
        nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
        leaves = {
            "linear": linear_stage(ocp),
            "bent": hessian_stage(ocp, self._plain_hessian),
            "end": hessian_end(ocp),
            "deformed": deformed_move(self.map, nu * n),
        }
        scale = ", ".join(repr(float(v)) for v in 1 / (ocp.step * ocp.curvature))
        constants = {
            "NS": ns,
            "NU": nu,
            "NT": ocp.data.size,
            "N": n,
            "MEMORY": self.memory(ocp).size,
            "SCALE": f"{{{scale}}}",
            "ITERATIONS": iterations,
            "STOP_EARLY": stop_early,
            "TOLERANCE": repr(self.tolerance),
            "DAMPING": repr(self.damping),
            "FIRST_GAMMA": repr(first_gamma(ocp)),
            "SHARE": SHARE,
            "ARMIJO": ARMIJO,
            "SHORTER": SHORTER,
            "SHORTEST": SHORTEST,
            "DRAWN_IN": DRAWN_IN,
            "ROUNDING": ROUNDING,
            "PLAIN": _PLAIN,
            "UNTRIED": UNTRIED,
            "FINITE": FINITE,
            "PIVOT": PIVOT,
            "ROUNDS": rounds(nu),
            "CONVERGED": int(Status.OK),
            "NOT_CONVERGED": int(Status.NOT_CONVERGED),
            "INFEASIBLE": int(Status.INFEASIBLE),
            "NON_FINITE": int(Status.NON_FINITE),
        }
        folder = resources.files("fpirhc.optimisers")
        texts = [
            folder.joinpath(f"{name}.c").read_text(encoding="utf-8") for name in ("kernels", "fixed_point", "entry")
        ]
        return Driver("\n".join(texts), leaves, constants)

    def _graph(self, ocp: OptimalControl, name: str) -> ca.Function:
        """The composed Function: what the driver is tested against, and what runs without a compiler."""
        search = Search(ocp, self._plain_hessian, self.map, self.damping)
        given, memory = self._arguments(ocp)
        anchor = self._begin(ocp, given, memory)
        for _ in range(self.iterations):
            anchor, plan = search.tried(anchor, given)
            anchor = search.directed(anchor, plan, given)
        anchor, _ = search.tried(anchor, given)
        return ca.Function(name, [*given, memory], self._finish(ocp, given, memory, anchor, self.iterations))

    def _converging_graph(self, ocp: OptimalControl, name: str) -> ca.Function:
        search = Search(ocp, self._plain_hessian, self.map, self.damping)
        given, memory = self._arguments(ocp)
        anchor, count, plain = self._begin(ocp, given, memory), ca.MX(0), ca.MX(0)
        symbols = Anchor(*(ca.MX.sym(name, *v.shape) for name, v in zip(Anchor._fields, anchor, strict=True)))
        tried, plan = search.tried(symbols, given)
        work = ca.Function("fpirhc_iteration", [*given, *symbols], list(search.directed(tried, plan, given)))
        rest = ca.Function("fpirhc_rest", [*given, *symbols], list(symbols))
        choice = ca.Function.if_else("fpirhc_iteration_if_needed", work, rest)
        for _ in range(MOST + 1):
            residual = stationarity(ocp, anchor.inputs, anchor.slope, given.lower, given.upper)
            needed = ca.logic_not(ca.logic_and(anchor.value < UNTRIED, residual <= self.tolerance))
            needed = ca.logic_and(needed, plain < _PLAIN)
            plain += ca.logic_and(needed, anchor.step < SHORTEST)
            anchor, count = Anchor(*choice(needed, *given, *anchor)), count + needed
        return ca.Function(name, [*given, memory], self._finish(ocp, given, memory, anchor, count - 1))

    def _arguments(self, ocp: OptimalControl) -> tuple[Given, ca.MX]:
        nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
        s0, data = ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
        lower, upper = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu)
        return Given(s0, data, lower, upper), ca.MX.sym("memory", self.memory(ocp).size)

    def _begin(self, ocp: OptimalControl, given: Given, memory: ca.MX) -> Anchor:
        """The remembered plan, not evaluated yet; a poisoned memory is forgotten."""
        nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
        kept = self.memory(ocp).split(ca.if_else(is_finite(memory), memory, 0))
        inputs = clip(ca.reshape(kept["plan_inputs"], nu, n), given.lower, given.upper)
        none = ca.MX.zeros(nu, n)
        first = first_gamma(ocp)
        resume = ca.if_else(kept["plan_step"] > 0, ca.fmin(kept["plan_step"], 1), 1)
        # After a rejected T a longer gamma would be rejected again, in every call of one iteration.
        longer = ca.if_else(resume < SHORTEST, 1, 2) * kept["plan_gamma"]
        gamma = ca.if_else(kept["plan_gamma"] > 0, ca.fmin(longer, first), first)
        return Anchor(
            inputs=inputs,
            states=ca.reshape(kept["plan_states"], ns, n),
            move=none,
            gains=ca.reshape(kept["plan_gains"], nu, ns * n),
            plain=clip(none, given.lower, given.upper),
            slope=none,
            value=ca.MX(10 * UNTRIED),
            envelope=ca.MX(10 * UNTRIED),
            step=ca.MX(1),
            gamma=gamma,
            resume=resume,
        )

    def _finish(
        self, ocp: OptimalControl, given: Given, memory: ca.MX, anchor: Anchor, iterations: ca.MX | int
    ) -> list[ca.MX]:
        posed, evaluated = sane(*given), anchor.value < UNTRIED
        finite = ca.logic_and(posed, evaluated)
        residual = stationarity(ocp, anchor.inputs, anchor.slope, given.lower, given.upper)
        status = ca.if_else(
            ca.mmax(given.lower - given.upper) > 0,
            int(Status.INFEASIBLE),
            status_of(finite, residual, 0, self.tolerance),
        )
        told = ca.if_else(finite, ca.vertcat(anchor.value, residual), ca.MX.zeros(2))
        found = self.memory(ocp).join(
            {
                "plan_inputs": ca.vec(anchor.inputs),
                "plan_states": ca.vec(anchor.states),
                "plan_gains": ca.vec(anchor.gains),
                "plan_gamma": anchor.gamma,
                "plan_step": anchor.step,
            }
        )
        # A remembered plan under which a well-posed problem overflows is given up, so that the next call can succeed.
        kept = ca.if_else(finite, found, ca.if_else(posed, ca.MX.zeros(found.shape), memory))
        return [anchor.inputs, ca.vertcat(told, 0, iterations, status), kept]


EXAMPLES = (FixedPoint(iterations=20, tolerance=1e-6), FixedPoint(iterations=1, tolerance=1e-6))
CHOICES = {"fixed-point": ("FPI", lambda tolerance: FixedPoint(iterations=1, tolerance=tolerance))}
