"""Open-loop solves of a problem's first horizon with the optimisers of its controllers, and a certificate of each plan.

A certificate says what is known beyond the residual: how fast the iteration contracts there, and how far the optimum is. Its
bounds, and where they hold, stand in docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from scipy.linalg import eigh

from fpirhc.describe import identity
from fpirhc.errors import InvalidProblem
from fpirhc.fields.checked import checked_call
from fpirhc.horizon.hessian_models import GaussNewton, hessian_end, hessian_stage, linear_stage
from fpirhc.horizon.problem import OptimalControl, reduced_gradient
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.plan import Plan, sensitivity_of, solve
from fpirhc.problem_files.problem_file import Task
from fpirhc.task.exogenous import model_values

_ROUNDING = 1e-14  # relative to the trace, added to the model before it is factorised
_REMEMBERED = 4  # horizons whose Functions are kept
_AT_BOUND = 1e-9  # relative distance within which an input counts as at its bound
_RANK = 1e-9  # relative singular value below which active limits depend on each other


@dataclass(frozen=True)
class Certificate:
    """What is known about a plan.

    Args:
        factor: K, infinite where it is not known.
        error: bound of the distance to the optimum in the M-norm (square root of cost), NaN where K >= 1.
        input_error: bound of the error of any input, in its unit.
        suboptimality: bound of V(U) - V(U*).
        curvature: least eigenvalue of M^-1 H; a plan where it is not positive is no strict minimum.
        active: number of limits of states with a multiplier.
        complementarity: largest product of a multiplier and the distance of its limit, in units of the cost.
    """

    factor: float
    error: float
    input_error: float
    suboptimality: float
    free: int
    curvature: float
    active: int = 0
    complementarity: float = 0.0


@checked_call
def certify(plan: Plan) -> Certificate:
    """Return what is known about a plan, a solved horizon, for full Gauss-Newton steps."""
    slope, hessian = _second_order(plan, plan.inputs)
    free, held = _free(plan, plan.inputs, slope), _active_limits(plan)
    active = len(held.rows)
    about = active, held.complementarity
    basis = _directions(free, held)
    if not basis.shape[1]:
        return Certificate(0.0, 0.0, 0.0, 0.0, 0, float("inf"), *about)
    model, pull = basis.T @ _model(plan) @ basis, basis.T @ slope
    norm = model + _ROUNDING * np.trace(model) * np.eye(model.shape[0])
    move = np.linalg.solve(model, pull)
    values = eigh(basis.T @ hessian @ basis, norm, eigvals_only=True)
    further = (plan.inputs.ravel(order="F") - basis @ move).reshape(plan.inputs.shape, order="F")
    inputs = np.clip(further, *(b[:, None] for b in plan.bounds))
    slope_there, hessian_there = _second_order(plan, inputs)
    same = bool(np.all(_free(plan, inputs, slope_there) == free))
    beyond = eigh(basis.T @ hessian_there @ basis, norm, eigvals_only=True)
    here, there = (float(np.abs(1 - v).max()) for v in (values, beyond))
    factor = max(here, there) + abs(here - there) if same else float("inf")
    length = float(np.sqrt(max(pull @ move, 0.0)))
    error = length / (1 - factor) if factor < 1 else float("nan")
    spread = float(np.sqrt(np.einsum("ij,jk,ik->i", basis, np.linalg.inv(model), basis).max()))
    suboptimality = length**2 / (2 * (1 - factor)) + held.complementarity * active if factor < 1 else float("nan")
    least, back = float(values.min()), _largest_return(held, free)
    return Certificate(factor, error, spread * error + back, suboptimality, basis.shape[1], least, *about)


def _second_order(plan: Plan, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (N nu) and exact Hessian (N nu, N nu) of the Lagrangian at these inputs, by Hessian-vector products."""
    slope, product = _derivatives(plan.problem)
    n, nu = plan.problem.stages, plan.problem.input.size
    point = plan.states[:, 0], at, plan.data, plan.state_multipliers
    directions_in_turn = np.eye(nu * n).reshape(-1, n, nu).transpose(2, 0, 1).reshape(nu, -1)
    columns = product(*point, directions_in_turn)
    return np.asarray(slope(*point).full()).ravel(), np.asarray(columns.full())


@lru_cache(maxsize=_REMEMBERED)
def _derivatives(ocp: OptimalControl) -> tuple[ca.Function, ca.Function]:
    """Functions of (first state, U, data, multipliers): the gradient (N nu), and, for N nu directions, columns of the Hessian."""
    gradient = reduced_gradient(ocp)
    nu, n = ocp.input.size, ocp.stages
    point = [ca.MX.sym(gradient.name_in(k), gradient.sparsity_in(k)) for k in range(4)]
    direction, slope = ca.MX.sym("d", nu, n), gradient(*point)[1]
    along = ca.jtimes(slope, point[1], direction)
    product = ca.Function("fpirhc_hessian_times", [*point, direction], [ca.vec(along)])
    columns = product.map("fpirhc_hessian_columns", "serial", nu * n, [0, 1, 2, 3], [])
    return ca.Function("fpirhc_slope", point, [ca.vec(slope)]), columns


@lru_cache(maxsize=_REMEMBERED)
def _stages(ocp: OptimalControl) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Functions of a stage's linear model and Hessian, and of the end's."""
    return linear_stage(ocp), hessian_stage(ocp, GaussNewton()), hessian_end(ocp)


def _free(plan: Plan, inputs: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Inputs that no active bound holds: not at a bound, or pushed away from it."""
    lower, upper = (np.tile(b, plan.problem.stages) for b in plan.bounds)
    values = inputs.ravel(order="F")
    near = _AT_BOUND * (1 + np.abs(values))
    held = ((values <= lower + near) & (slope > 0)) | ((values >= upper - near) & (slope < 0))
    return ~held


def _model(plan: Plan) -> np.ndarray:
    """M (N nu, N nu) at the plan, by propagating the linearised model."""
    ocp, data = plan.problem, plan.data
    n, nu = ocp.stages, ocp.input.size
    linear, hessians, end = _stages(ocp)
    sensitivity, total = np.zeros((ocp.state.size, n * nu)), np.zeros((n * nu, n * nu))
    for i in range(n):
        s, u, theta = plan.states[:, i], plan.inputs[:, i], data[:, i]
        _, _, a, b, _, _ = (np.asarray(v.full()) for v in linear(s, u, theta))
        q, cross, r = (np.asarray(v.full()) for v in hessians(s, u, theta, np.zeros(ocp.state.size)))
        own = slice(i * nu, (i + 1) * nu)
        total += sensitivity.T @ q @ sensitivity
        total[own] += cross @ sensitivity
        total[:, own] += (cross @ sensitivity).T
        total[own, own] += r
        sensitivity = a @ sensitivity
        sensitivity[:, own] += b
    final = np.asarray(end(plan.states[:, n], data[:, n])[2].full())
    return np.asarray(total + sensitivity.T @ final @ sensitivity)


@dataclass(frozen=True, eq=False)
class _Active:
    """Active limits of states."""

    rows: np.ndarray  # J, shape (count, N nu)
    distances: np.ndarray  # of the states beyond their limits, positive where violated, shape (count,)
    complementarity: float  # largest product of a multiplier and the distance of its limit


def _active_limits(plan: Plan) -> _Active:
    ocp, multipliers = plan.problem, plan.state_multipliers
    has_multiplier = multipliers.ravel(order="F") != 0
    if not has_multiplier.any():
        return _Active(np.zeros((0, plan.inputs.size)), np.zeros(0), 0.0)
    _, _, sensitivity = sensitivity_of(ocp)(plan.states[:, 0], plan.inputs, plan.data)
    limits = np.where(multipliers > 0, ocp.state_upper[:, None], ocp.state_lower[:, None]).ravel(order="F")
    active = multipliers.ravel(order="F")[has_multiplier]
    beyond = np.sign(active) * (plan.states[:, 1:].ravel(order="F") - limits)[has_multiplier]
    products = np.abs(beyond * active)
    return _Active(np.asarray(sensitivity.full())[has_multiplier], beyond, float(products.max()))


def _directions(free: np.ndarray, active: _Active) -> np.ndarray:
    """Return an orthonormal basis (N nu, k) of the moves of free inputs along which no active limit changes."""
    selected = np.eye(free.size)[:, free]
    if not len(active.rows) or not free.any():
        return selected
    _, sizes, turned = np.linalg.svd(active.rows[:, free])
    rank = int((sizes > _RANK * sizes.max()).sum())
    return np.asarray(selected @ turned[rank:].T)


def _largest_return(active: _Active, free: np.ndarray) -> float:
    """Return the largest entry of the shortest move of free inputs that puts the active limits right, to first order."""
    if not len(active.rows) or not free.any():
        return 0.0
    return float(np.abs(np.linalg.pinv(active.rows[:, free], rcond=_RANK) @ active.distances).max())


@dataclass(frozen=True, eq=False)
class Solved:
    """One optimiser's plan."""

    name: str  # of the controllers whose optimiser it is
    plan: Plan
    certificate: Certificate | None  # certificate of the plan; None where the plan is not inside its bounds


def first_plans(task: Task, controllers: Sequence[str] | None) -> list[Solved]:
    """Solve the horizon that begins at the start of the problem, with the approximate model and the optimiser of each controller.

    `controllers`: names of those whose optimisers are meant; None: all that plan. Optimisers that are alike solve it once.
    """
    problem = task.problem
    own = {name: task.controllers[name].planner for name in controllers or task.controllers}
    planners = {name: one for name, one in own.items() if one is not None}
    if problem.horizon is None or not planners:
        raise InvalidProblem(f"problem '{task.name}' has no horizon, or none of {', '.join(own)} plans by an optimiser")
    alike: dict[object, list[str]] = {}
    for name, one in planners.items():
        alike.setdefault(identity((one.optimiser, one.cost)), []).append(name)
    plant, limits, start = problem.plant, problem.limits, problem.start_state
    ahead = model_values(plant, problem.signals)
    solved = []
    for names in alike.values():
        optimiser, cost = planners[names[0]].optimiser, planners[names[0]].cost or problem.cost
        if cost is None:
            raise InvalidProblem(f"problem '{task.name}' has no cost; give Problem(cost=...)")
        ocp = transcribe(plant, problem.reference, problem.horizon, cost, limits, ahead, start)
        first = np.asarray(ocp.start(start, problem.inputs_before).full()).ravel()
        plan = solve(ocp, optimiser, first, ocp.nodes[2])
        solved.append(Solved(", ".join(names), plan, None if plan.overflow() else certify(plan)))
    return solved
