"""Fixed-point iteration on the reduced gradient, preconditioned by one Riccati sweep: the default optimiser.

U+ = G(U, h, 0) with h = M^-1 g deforms the plan as a control loop deforms its request (docs/theory.md). With limits of
states, and where its plain iteration does not contract, it is that of state_limits.c, which ends where the plan is solved.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, replace
from importlib import resources

import casadi as ca
import numpy as np

from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.model_referenced import require_map_of_plan
from fpirhc.errors import CompileError, InvalidValue, NotInstalled, require
from fpirhc.fields.kinds import Count, NotNegative, Positive
from fpirhc.horizon.hessian_models import (
    ExactHessian,
    GaussNewton,
    HessianModel,
    hessian_end,
    hessian_stage,
    partial_count,
    split_hessian,
    split_stage,
)
from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers import (
    FEASIBLE,
    KEPT,
    LAST,
    Columns,
    Optimiser,
    Scales,
    built,
    compiled_plan,
    paid,
    require_compiler,
    scales,
    shift,
    shift_gains,
    with_last,
)
from fpirhc.optimisers.plain import CLOSE, PlainSettings, plain_memory, plain_step, shifted_plain
from fpirhc.optimisers.search import deformed_move
from fpirhc.status import Status
from fpirhc.symbolic.driver import Driver
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import FINITE
from fpirhc.symbolic.layout import Layout, Signal, scalar

_TEXTS = ("kernels", "state_limits_sweep", "state_limits")


@dataclass(frozen=True)
class LimitedSettings:
    """Settings of one Function."""

    tolerance: float  # of the stationarity, in the unit of the inputs
    map: Deformation  # the deformation of pure steps
    hessian: (
        HessianModel | None
    )  # second derivatives; None: exact, and Gauss-Newton first where a remembered plan is improved
    damping: float  # added to the curvature of the inputs, in units of it
    iterations: int  # most iterations of one call


def limited_memory(ocp: OptimalControl) -> Layout:
    """Return the layout of plan, states, costates, feedback, multipliers, mu (zero: no plan is remembered) and damping."""
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
            scalar("plan_barrier"),
            scalar("plan_damping"),
        )
    )


def limited_step(ocp: OptimalControl, settings: LimitedSettings) -> ca.Function:
    """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory); it raises as `compiled_plan` does."""
    # The number of iterations is an argument of the loops: one library serves a loop and plans in open loop.
    alike = replace(settings, iterations=0)
    plan = _PLANS.of((ocp, settings.map), (alike,), lambda: _compiled(ocp, alike))
    return with_last(ocp, plan, settings.iterations)


def _compiled(ocp: OptimalControl, settings: LimitedSettings) -> ca.Function:
    return compiled_plan(ocp, "fpirhc_limited", _driver(ocp, settings), limited_memory(ocp).size)


_PLANS: Latest[ca.Function] = Latest(8)


def shifted_limited(ocp: OptimalControl, memory: ca.MX) -> ca.MX:
    """Return the memory one stage later; the last stage, which is repeated, has no feedback."""
    layout, n, nu, ns = limited_memory(ocp), ocp.stages, ocp.input.size, ocp.state.size
    parts = layout.split(memory)
    rows = layout["plan_multipliers"].size // (2 * n)
    sides = ca.horzsplit(ca.reshape(parts["plan_multipliers"], rows, 2 * n), n)
    shifted_parts: dict[str, ca.MX] = {
        name: ca.vec(shift(ca.reshape(parts[name], size, n), ocp, node))
        for name, size, node in (("plan_inputs", nu, 0), ("plan_states", ns, 1), ("plan_costates", ns, 1))
    }
    shifted_parts["plan_gains"] = shift_gains(parts["plan_gains"], nu * ns, ocp)
    shifted_parts["plan_multipliers"] = ca.vec(ca.horzcat(*(shift(side, ocp) for side in sides)))
    return layout.join({**parts, **shifted_parts})


def _driver(ocp: OptimalControl, settings: LimitedSettings) -> Driver:
    """The loops in C with what they call."""
    measures = scales(ocp)
    leaves = {
        "evaluate": split_stage(ocp)["evaluate"],
        "linearise": split_stage(ocp)["linearise"],
        **split_hessian(ocp, settings.hessian or ExactHessian()),
        "plain": hessian_stage(ocp, GaussNewton()),
        "end": hessian_end(ocp),
        "deformed": deformed_move(settings.map, ocp.input.size * ocp.stages),
        "guess": _guess(ocp),
    }
    folder = resources.files("fpirhc.optimisers")
    texts = [folder.joinpath(f"{name}.c").read_text(encoding="utf-8") for name in _TEXTS]
    sizes = {"NM": partial_count(ocp), "NH": leaves["curve"].numel_in(0), **_sizes(ocp, measures)}
    constants = {**sizes, **_constants(settings, measures), "ITERATIONS": LAST}
    return Driver("\n".join(texts), leaves, constants, _room(ocp, measures))


def _room(ocp: OptimalControl, measures: Scales) -> int:
    """Numbers of the struct Room of state_limits.c."""
    nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
    inputs, states, limits = n * nu, (n + 1) * ns, n * (nu + len(measures.bounded))
    point = 2 * inputs + states + n * ns * (2 + ns + nu) + ns + ns * ns + 1
    direction = 2 * inputs + inputs * ns + 2 * states
    kept = 2 * inputs + 2 * states + 6 * limits + n * ns
    shared = max(states * (ns + 1) + 6 * limits, n * partial_count(ocp))
    return 2 * point + 2 * 6 * limits + direction + kept + shared


def _sizes(ocp: OptimalControl, measures: Scales) -> dict[str, object]:
    places = list(measures.bounded)
    return {
        "NS": ocp.state.size,
        "NU": ocp.input.size,
        "NT": ocp.data.size,
        "N": ocp.stages,
        "NB": len(places),
        "MEMORY": limited_memory(ocp).size,
        "PLACES": _row(np.array([*places, 0])),
        "CURVATURE": _row(ocp.step * ocp.curvature),
        "UNITS": _row(np.append(measures.rows, 1.0)),
        "SPREADS": _row(measures.states),
        "CAPACITIES": _row(np.append(measures.capacity, 0.0)),
        "HARD": _row(np.append(measures.hard.astype(float), 0.0)),
        "STATE_LOWER": _row(np.append(ocp.state_lower[places], 0.0)),
        "STATE_UPPER": _row(np.append(ocp.state_upper[places], 0.0)),
    }


def _constants(settings: LimitedSettings, measures: Scales) -> dict[str, object]:
    statuses = {
        "CONVERGED": Status.OK,
        **{s.name: s for s in (Status.NOT_CONVERGED, Status.INFEASIBLE, Status.NON_FINITE)},
    }
    return {
        **{name: int(status) for name, status in statuses.items()},
        "COST": repr(float(measures.cost)),
        "NEAR_LIMIT": FEASIBLE,
        "KEPT_SHARE": KEPT,
        "DAMPING": repr(float(settings.damping)),
        "TOLERANCE": repr(float(settings.tolerance)),
        "SCALED_TOLERANCE": repr(float(max(settings.tolerance / measures.inputs.min(), 1e-12))),
        "PLAIN_FIRST": int(settings.hessian is None),
    }


def _guess(ocp: OptimalControl) -> ca.Function:
    """Function theta -> (reference as a stage's state (ns), that of the nodes where there is none, feedforward (nu))."""
    theta = ca.SX.sym("theta", ocp.data.size)
    reference, forward = (theta[ocp.data.slice(name)] for name in ("reference", "feedforward"))
    reference = ocp.state_of(reference)
    rest = ocp.state.size - reference.numel() - ocp.written
    state = ca.vertcat(reference, *([forward] if rest else []), ca.SX.zeros(ocp.written))
    return ca.Function("fpirhc_guess", [theta], [ca.densify(state), ca.densify(forward)])


def _row(values: np.ndarray) -> str:
    """A C initialiser; what is infinite, a limit that is absent, becomes a number beyond every finite one."""
    texts = (repr(v) if abs(v) <= FINITE else "10 * FINITE" for v in values.tolist())
    return "{" + ", ".join(texts) + "}"


_DIGITS = 1e-15  # relative rounding of a number
_MOST_LIMITED = 1000  # iterations of one open-loop call with limits of states
_GROWTH = 1e12  # of a motion of the model over the horizon, beyond which rollouts of plans leave their gradients too few digits
_CONVEX = 1e-6  # relative eigenvalue below zero that is taken for rounding


@dataclass(frozen=True)
class FixedPointSolver(Optimiser):
    """Plans by fixed-point iteration on their inputs, with the model alone. The adaptation (FPI) is a deformation.

    Args:
        iterations: per call without limits of states. None: a call ends where its plan is solved, after at most 50; it takes at
            least one. A number: exactly so many, whatever they achieve; 1 is one step per control cycle.
        tolerance: of the stationarity and of the move that a sweep wants (in the unit of the inputs), below which a plan is
            converged; None: 1e-4 of half the smallest range of an input, or of its size along the reference. The status of a call
            is OK where the plan that it returns is below it, and NOT_CONVERGED elsewhere, also after so many iterations.
        map: the deformation that makes the next plan; Affine(gain=-2.0) is the full step, a Sigmoid's scale limits it.
        hessian: GaussNewton() or ExactHessian(); None is Gauss-Newton without limits of states; with them the exact Hessian, and
            Gauss-Newton first where a remembered plan is improved.
        damping: mu >= 0 added to the input's curvature, in units of it: 0 is Gauss-Newton, large values are gradient descent.
        most_iterations: of one call with limits of states in a loop. The call ends where the plan is solved, a remembered plan
            usually after a handful. A call that uses all of them is NOT_CONVERGED, and returns the better one of its plan and the
            plan in force.
        second_start: whether a call also begins without the remembered plan, and takes the cheaper one of two solved plans. An
            economic cost has several minima, and a remembered plan stays in its own; a call takes twice as long.
    """

    iterations: Count | None = None
    tolerance: Positive | None = None
    map: Deformation = field(default_factory=lambda: Affine(gain=-2.0))
    hessian: HessianModel | None = None
    damping: NotNegative = 0.0
    most_iterations: Count = 100
    second_start: bool = field(default=False, kw_only=True)

    def check(self, ocp: OptimalControl) -> None:
        """Raise if plans cannot be rolled out, the tolerance cannot be met, or the cost is not convex where the Hessian needs that.

        Raises:
            NotInstalled: limits of states without a C compiler.
            NotSupported: a discretised model that runs away along the reference, as Runge-Kutta steps of fast modes do;
                a cost whose quadratic model has no minimum; a model-referenced map.
            InvalidValue: a tolerance below the rounding of inputs.
        """
        require_map_of_plan("FixedPointSolver", self.map)
        if ocp.bounds_states:
            require_compiler()
        reach = np.abs(np.concatenate([ocp.input_lower, ocp.input_upper, ocp.nodes[1].ravel()]))
        rounding = _DIGITS * float(reach[np.isfinite(reach)].max(initial=0.0))
        if self.tolerance is not None and self.tolerance < rounding:
            raise InvalidValue(
                f"FixedPointSolver(tolerance={self.tolerance:g}): inputs of this size are rounded to {rounding:.1g}; "
                f"use {1e3 * rounding:.0g}"
            )
        # With limits of states a plan has states of its own and feedback between them, which holds a plant that runs away itself.
        _require_rollouts(ocp.runaway() if ocp.bounds_states else ocp.along.growth())
        least = ocp.along.least_curvature()
        require(
            least >= -_CONVEX or not (self.hessian is None or self.hessian.needs_convex_cost),
            "FixedPointSolver needs a cost that bends upwards; along the reference the stage or terminal cost has an eigenvalue "
            f"of {least:.2g} times its largest. Use ReducedGradient() or Ipopt(), or FixedPointSolver(hessian=ExactHessian()) for "
            f"an economic cost or an output that saturates, or add a convex term to the cost",
        )

    def memory(self, ocp: OptimalControl) -> Layout:
        return limited_memory(ocp) if ocp.bounds_states else plain_memory(ocp)

    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        return shifted_limited(ocp, memory) if ocp.bounds_states else shifted_plain(ocp, memory)

    def step(self, ocp: OptimalControl) -> ca.Function:
        if ocp.bounds_states:
            return self._begun(ocp, limited_step(ocp, self._limited(ocp, self.most_iterations)))
        return self._begun(ocp, plain_step(ocp, self._plain(ocp, converging=False)))

    def converging(self, ocp: OptimalControl) -> ca.Function:
        """Return a Function like `step` that goes on until the tolerance is met."""
        if ocp.bounds_states:
            return self._begun(ocp, limited_step(ocp, self._limited(ocp, _MOST_LIMITED)))
        return self._begun(ocp, plain_step(ocp, self._plain(ocp, converging=True)))

    def improve(self, ocp: OptimalControl, call: Columns) -> Columns:
        """Return the results of a call of `converging`, or better ones where it does not end OK."""
        results: Columns = [np.asarray(v.full()) for v in built(self, ocp, self.converging)(*call)]
        if results[1][4, 0] != Status.OK and not ocp.bounds_states:
            with contextlib.suppress(NotInstalled, CompileError):
                limited = limited_step(ocp, self._limited(ocp, _MOST_LIMITED))
                return _better(ocp, self.memory(ocp), limited, call, results)
        return results

    def _begun(self, ocp: OptimalControl, one: ca.Function) -> ca.Function:
        return _of_two_starts(ocp, one, self.memory(ocp)) if self.second_start else one

    def _plain(self, ocp: OptimalControl, *, converging: bool) -> PlainSettings:
        hessian = self.hessian or GaussNewton()
        return PlainSettings(self._tolerance(ocp), self.map, hessian, self.damping, self.iterations or 0, converging)

    def _tolerance(self, ocp: OptimalControl) -> float:
        return CLOSE * ocp.input_size if self.tolerance is None else self.tolerance

    def _limited(self, ocp: OptimalControl, iterations: int) -> LimitedSettings:
        return LimitedSettings(self._tolerance(ocp), self.map, self.hessian, self.damping, iterations)


def _require_rollouts(growth: np.ndarray) -> None:
    """Raise if a motion of the model grows so much over the horizon, by these factors per stage, that rollouts have no digits."""
    require(
        np.prod(growth) <= _GROWTH or not np.isfinite(growth).all(),
        f"FixedPointSolver rolls its plans out; the discretised model multiplies a motion by {growth.max():.3g} in a stage and by "
        f"{np.prod(growth):.1g} over the horizon, so plans have no digits. Where the plant itself does not run away so, a fast "
        f"mode is the cause: use Horizon(discretisation=Collocation()), or RungeKutta4(substeps=...) with more sub-steps; else "
        f"limit a state, however widely, Limits(states=...), so that plans have states of their own, or use fewer stages",
    )


EXAMPLES = (FixedPointSolver(iterations=20, tolerance=1e-6), FixedPointSolver(iterations=1, tolerance=1e-6))


def _better(ocp: OptimalControl, layout: Layout, limited: ca.Function, call: Columns, first: Columns) -> Columns:
    """The better results of the plain iteration and of the one with limits from the same inputs, in the plain one's memory."""
    own, ns = limited_memory(ocp), ocp.state.size
    begin = own.start()
    begin[own.slice("plan_inputs")] = call[4][layout.slice("plan_inputs")]
    inputs, numbers, remembered = (np.asarray(v.full()) for v in limited(*call[:4], begin))
    status_and_stationarity = [4, 1]
    if tuple(numbers[status_and_stationarity, 0]) >= tuple(first[1][status_and_stationarity, 0]):
        return first
    numbers[3] += first[1][3]
    memory = layout.start()
    memory[layout.slice("plan_inputs")] = inputs.ravel(order="F")
    memory[layout.slice("plan_states")] = np.append(call[0], remembered[own.slice("plan_states"), 0][:-ns])
    memory[layout.slice("plan_gains")] = remembered[own.slice("plan_gains"), 0]
    memory[layout.slice("plan_step")] = 1
    return inputs, numbers, memory


def _of_two_starts(ocp: OptimalControl, one: ca.Function, memory: Layout) -> ca.Function:
    """Function like the step `one`: its result, or that from the start of its memory where that is solved and cheaper."""
    arguments = [ca.MX.sym(one.name_in(k), *one.size_in(k)) for k in range(one.n_in())]
    warm, cold = one(*arguments), one(*arguments[:4], ca.MX(ca.DM(memory.start())))
    solved = [result[1][4] == int(Status.OK) for result in (warm, cold)]
    # The cost of a plan does not count what its violations of priced limits cost, which its optimum does.
    price = paid(ocp)
    costs = [result[1][0] + price(arguments[0], result[0], arguments[1]) for result in (warm, cold)]
    cheaper = ca.logic_or(ca.logic_not(solved[0]), costs[1] < costs[0])
    better = ca.logic_and(solved[1], cheaper)
    count = ca.vertcat(ca.MX.zeros(3), 1, 0)
    chosen = [ca.if_else(better, new, old) for new, old in zip(cold, warm, strict=True)]
    other = ca.if_else(better, warm[1][3], cold[1][3])
    chosen[1] = chosen[1] + count * other
    return ca.Function(f"{one.name()}_twice", arguments, chosen)
