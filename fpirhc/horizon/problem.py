"""The optimal control problem of one horizon in standard form, its rollout, and its gradient by one backward sweep.

    minimise  V(U) = sum_{i<N} l(s_i, u_i, theta_i) + T(s_N, theta_N)
    where     s_{i+1} = F(s_i, u_i, theta_i),  s_0 given,  bounds on u_i and on s_1 ... s_N.

theta_i are the data of stage i: its time, the reference, the feedforward and the model's parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.symbolic.layout import Expression, Layout, Signal

_LEAST = 1e-3  # of what inputs move a state by: a smaller spread of the reference is no measure of it
_NOTHING = 1e-9  # of the same: a spread of rounding
_POWER_STEPS = 50
_RUNS_AWAY = 2e3  # times that a motion of the model grows over the horizon
_MARGIN = 1.1  # a power iteration approaches the eigenvalue from below


@dataclass(frozen=True, eq=False)
class OptimalControl:
    """The standard form; sizes: ns = state.size, nu = input.size, ntheta = data.size. Bounds are infinite where free.

    Args:
        stages: number of stages N.
        step: length of the first stage, s.
        state: signal of s_i.
        input: signal of u_i.
        data: layout of theta_i.
        data_of: returns a function (time, parameters) -> theta of all stages; `previewed`: as `stage_data` says.
        dynamics: (s, u, theta) -> s_next.
        stage_cost: (s, u, theta) -> (l, terms).
        terminal_cost: (s, theta) -> T.
        terms: names of the stage cost's terms.
        start: (x, u before) -> s_0, from the plant's state and the input of the stage before.
        state_lower: bounds of s_1 ... s_N, shape (ns,).
        state_upper: bounds of s_1 ... s_N, shape (ns,).
        input_lower: bounds of u_i, shape (nu,); a call of an optimiser may have others.
        input_upper: bounds of u_i, shape (nu,); a call of an optimiser may have others.
        ends: returns these bounds less a shift, of (shift of the lower ones, of the upper ones), shape (nu,) each.
        curvature: second derivative of the cost rate along each input near the reference, shape (nu,); it converts gradients to the
            units of the inputs.
        nodes: states, inputs and data along the reference from t = 0.
        along: quadratic model of the cost along the reference.
        state_of: gives the model's state on the reference; a state that has none there has a value of its own.
        written: number of the last entries of the state, which are limits of rates and paths; they are zero in s_0.
        state_price: cost of a violation of a state's bounds per unit and node, shape (ns,); infinite where they are hard.
        node_times: of s_0 ... s_N from the start, shape (N + 1,), s.
        shares: times from plan to plan per stage's length, shape (N,); ones where every plan follows one stage later.
        runaway: function that returns the factors by which the stages along the reference make a motion grow that decays in the
            plant, shape (N,).
        functions: Functions that were built for it; problems that differ in numbers of settings only share them.
    """

    stages: int
    step: float
    state: Signal
    input: Signal
    data: Layout
    data_of: Callable[..., Callable[..., Any]]
    dynamics: ca.Function
    stage_cost: ca.Function
    terminal_cost: ca.Function
    terms: tuple[str, ...]
    start: ca.Function
    state_lower: np.ndarray
    state_upper: np.ndarray
    input_lower: np.ndarray
    input_upper: np.ndarray
    ends: Callable[[Expression, Expression], tuple[Expression, Expression]]
    curvature: np.ndarray
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray]
    along: _ReferenceExpansion
    state_of: Callable[[ca.SX], ca.SX]
    written: int
    state_price: np.ndarray
    node_times: np.ndarray
    shares: np.ndarray
    runaway: Callable[[], np.ndarray] = lambda: np.ones(1)
    functions: dict[object, ca.Function] = field(default_factory=dict, repr=False)

    @property
    def scale(self) -> np.ndarray:
        """D = 1 / (step c), shape (nu,): it turns a gradient into a move of the inputs."""
        return 1 / (self.step * self.curvature)

    @property
    def measured_at_rest(self) -> OptimalControl:
        """The problem whose D is that of later inputs at rest: one that runs away enlarges what inputs of plans are rounded by."""
        return replace(self, curvature=curvature_at_rest(self.along, self.step))

    @cached_property
    def steepest(self) -> float:
        """Largest eigenvalue of D V'' along the reference, with a margin."""
        return steepest_curvature(self.along, self.scale)

    @property
    def input_size(self) -> float:
        """Half the smallest range of an input; one without limits counts with its size along the reference."""
        half = 0.5 * (self.input_upper - self.input_lower)
        usable = np.isfinite(half) & (half > 0)
        sizes = half if usable.all() else np.where(usable, half, sizes_along(self.nodes[1]))
        return float(sizes.min())

    @property
    def half_ranges(self) -> np.ndarray:
        """Half the range of every state's limits (ns,); infinite where a side is free or the limits are equal."""
        with np.errstate(invalid="ignore"):
            half = 0.5 * (self.state_upper - self.state_lower)
        return np.where(self.state_lower == self.state_upper, np.inf, half)

    @property
    def hard(self) -> np.ndarray:
        """Which states have bounds without a price (ns,)."""
        return np.isinf(self.state_price)

    @property
    def time_unit(self) -> str:
        """Unit of time."""
        return self.data["time"].entry_units[0]

    @property
    def bounds_states(self) -> bool:
        """Whether some state is bounded."""
        return bool(np.isfinite(self.state_lower).any() or np.isfinite(self.state_upper).any())


@dataclass(frozen=True, eq=False)
class _ReferenceExpansion:
    """The quadratic model, stage by stage."""

    a: np.ndarray  # A, shape (N, ns, ns)
    b: np.ndarray  # B, shape (N, ns, nu)
    q: np.ndarray  # Q, shape (N, ns, ns)
    s: np.ndarray  # S, shape (N, nu, ns)
    r: np.ndarray  # R, shape (N, nu, nu)
    final: np.ndarray  # Q of the end, shape (ns, ns)

    def hessian_times(self, moves: np.ndarray) -> np.ndarray:
        """Return M U for U (N, nu), with M the Hessian of V with the dynamics linearised."""
        stages = moves.shape[0]
        states = np.zeros((stages + 1, self.a.shape[1]))
        for i in range(stages):
            states[i + 1] = self.a[i] @ states[i] + self.b[i] @ moves[i]
        costate, result = self.final @ states[stages], np.empty_like(moves)
        for i in reversed(range(stages)):
            result[i] = self.r[i] @ moves[i] + self.s[i] @ states[i] + self.b[i].T @ costate
            costate = self.q[i] @ states[i] + self.s[i].T @ moves[i] + self.a[i].T @ costate
        return result

    def sensitivity(self) -> np.ndarray:
        """Return dS/dU, shape (N, ns, N nu): the derivatives of the states s_1 ... s_N by the inputs."""
        stages, ns, nu = self.b.shape
        slope, slopes = np.zeros((ns, stages * nu)), np.empty((stages, ns, stages * nu))
        for i in range(stages):
            slope = self.a[i] @ slope
            slope[:, i * nu : (i + 1) * nu] += self.b[i]
            slopes[i] = slope
        return slopes

    def moved_by(self, inputs: np.ndarray) -> np.ndarray:
        """Return the most by which finite inputs of this size (nu,) in the first stage move every state, (ns,).

        So many stages count as there are states: then an input has reached what it reaches, and a plant that runs away has not run.
        """
        slope = self.b[0] * np.where(np.isfinite(inputs), inputs, 0.0)
        most = np.abs(slope).max(axis=1, initial=0.0)
        with np.errstate(all="ignore"):
            for a in self.a[1 : self.b.shape[1]]:
                slope = a @ slope
                most = np.fmax(most, np.abs(slope).max(axis=1, initial=0.0))
        return np.where(np.isfinite(most), most, 0.0)

    def growth(self) -> np.ndarray:
        """Largest factor |eigenvalue of dF/ds| by which a motion grows in each stage, shape (N,)."""
        finite, factors = np.isfinite(self.a).all(axis=(1, 2)), np.full(len(self.a), np.nan)
        factors[finite] = np.abs(np.linalg.eigvals(self.a[finite])).max(axis=1)
        return factors

    def least_curvature(self) -> float:
        """Smallest eigenvalue of a stage's cost Hessian, relative to its largest."""
        blocks = np.block([[self.q, self.s.transpose(0, 2, 1)], [self.s, self.r]])
        values, ends = np.linalg.eigvalsh(blocks), np.linalg.eigvalsh(self.final)
        size = max(np.abs(values).max(), np.abs(ends).max(), 1e-300)
        return float(min(values.min(), ends.min()) / size)


def expand_along(
    dynamics: ca.Function,
    stage_cost: ca.Function,
    terminal_cost: ca.Function,
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray],
    functions: dict[object, ca.Function] | None = None,
) -> _ReferenceExpansion:
    """Return the quadratic model along nodes (states, inputs, data); `functions` keeps its Functions for the next call."""
    functions = {} if functions is None else functions
    if "linearised" not in functions:
        end, theta = terminal_cost.sx_in()
        curved = [ca.densify(ca.hessian(terminal_cost(end, theta), end)[0])]
        functions["final"] = ca.Function("fpirhc_final", [end, theta], curved)
        functions["linearised"] = _linearised(dynamics, stage_cost)
    states, inputs, data = nodes
    stages = inputs.shape[1]
    linearised = functions["linearised"]
    derivatives = [
        [np.asarray(v.full()) for v in linearised(states[:, i], inputs[:, i], data[:, i])] for i in range(stages)
    ]
    final = np.asarray(functions["final"](states[:, stages], data[:, stages]).full())
    a, b, q, s, r = (np.array([stage[k] for stage in derivatives]) for k in range(5))
    return _ReferenceExpansion(a, b, q, s, r, final)


def sizes_along(states: np.ndarray, moved: np.ndarray | float = 1.0) -> np.ndarray:
    """Return half the spread of every state along the reference and a tenth of its size, (ns,), at least a share of `moved`.

    A state that rests at zero has the size of what it is moved by; 1 where nothing is known to move it.
    """
    about, moves = 0.5 * np.ptp(states, axis=1) + 0.1 * np.abs(states).max(axis=1), np.asarray(moved)
    sizes = np.where(about > _NOTHING * moves, np.maximum(about, _LEAST * moves), moves)
    return np.where(sizes > 0, sizes, 1.0)


def input_curvature(along: _ReferenceExpansion, step: float) -> np.ndarray:
    """Return c (nu,), positive, that of later inputs at rest.

    Where the model runs away over the horizon that is no measure of a plan, because every plan looks stationary: there it is the
    curvature that is left once all later inputs answer.
    """
    rest = curvature_at_rest(along, step)
    if not np.prod(along.growth()) > _RUNS_AWAY:
        return rest
    answered = answered_curvature(along) / step
    return np.where(np.isfinite(answered) & (answered > 0), answered, rest)


def curvature_at_rest(along: _ReferenceExpansion, step: float) -> np.ndarray:
    """Return the curvature of the cost rate along the first stage's inputs (nu,), positive, with later inputs at rest.

    An input without curvature gets the largest curvature of the others, or 1 where no input has one.
    """
    slope, total = along.b[0], along.r[0].diagonal().copy()
    with np.errstate(all="ignore"):
        for a, q in zip(along.a[1:], along.q[1:], strict=True):
            total += np.einsum("ik,ij,jk->k", slope, q, slope)
            slope = a @ slope
        total = np.abs(total + np.einsum("ik,ij,jk->k", slope, along.final, slope)) / step
    usable = np.isfinite(total) & (total > 0)
    return np.where(usable, total, total[usable].max() if usable.any() else 1.0)


def answered_curvature(along: _ReferenceExpansion) -> np.ndarray:
    """Return the diagonal of Q_uu (nu,) of the first stage, by a Riccati sweep; it may be no positive number."""
    value = along.final
    with np.errstate(all="ignore"):  # of a step that grows beyond every number
        for a, b, q, s, r in zip(*(v[::-1] for v in (along.a, along.b, along.q, along.s, along.r)), strict=True):
            q_uu, cross = r + b.T @ value @ b, s + b.T @ value @ a
            if not (np.isfinite(q_uu).all() and np.isfinite(cross).all()):
                return np.full(len(q_uu), np.nan)
            value = q + a.T @ value @ a - cross.T @ np.linalg.lstsq(q_uu, cross, rcond=None)[0]
    return np.asarray(q_uu.diagonal())


def steepest_curvature(along: _ReferenceExpansion, scale: np.ndarray) -> float:
    """Return the largest eigenvalue of D M, with D = diag(scale) (nu,) for every stage, found by power iteration."""
    direction = np.random.default_rng(0).standard_normal(along.b.shape[::2])
    largest = 0.0
    for _ in range(_POWER_STEPS):
        size = np.linalg.norm(direction)
        if not (np.isfinite(size) and size > 0):
            return 1.0
        direction = scale * along.hessian_times(direction / size)
        largest = float(np.linalg.norm(direction))
    return _MARGIN * largest if np.isfinite(largest) and largest > 0 else 1.0


def _linearised(dynamics: ca.Function, stage_cost: ca.Function) -> ca.Function:
    """Function (s, u, theta) -> (dF/ds, dF/du, d2l/ds2, d2l/duds, d2l/du2)."""
    s, u, theta = dynamics.sx_in()
    next_state, cost = dynamics(s, u, theta), stage_cost(s, u, theta)[0]
    slope = ca.gradient(cost, u)
    second = [ca.hessian(cost, s)[0], ca.jacobian(slope, s), ca.jacobian(slope, u)]
    results = [ca.jacobian(next_state, s), ca.jacobian(next_state, u), *second]
    return ca.Function("fpirhc_linearised", [s, u, theta], [ca.densify(r) for r in results])


def rollout(ocp: OptimalControl) -> ca.Function:
    """Function (s0, U (nu, N), data (ntheta, N + 1)) -> (S (ns, N + 1), V, cost by term summed over the stages)."""
    n, (s, u, theta) = ocp.stages, ocp.dynamics.sx_in()
    one = ca.Function("fpirhc_forward_stage", [s, u, theta], [ocp.dynamics(s, u, theta), *ocp.stage_cost(s, u, theta)])
    s0, inputs, data = _symbols(ocp)
    states, costs, terms = one.mapaccum("fpirhc_rollout_stages", n)(s0, inputs, data[:, :n])
    total = ca.sum2(costs) + ocp.terminal_cost(states[:, -1], data[:, n])
    results = [ca.horzcat(s0, states), total, ca.sum2(terms)]
    return ca.Function("fpirhc_rollout", [s0, inputs, data], results, ["s0", "U", "data"], ["S", "V", "terms"])


def reduced_gradient(ocp: OptimalControl) -> ca.Function:
    """Function (s0, U, data, M (ns, N)) -> (V, g (nu, N), S, costates (ns, N + 1)).

    M are multipliers of state bounds: g is then the gradient of V + sum_i M_i' s_{i+1}. Zero without state bounds.
    """
    n, (s, u, theta) = ocp.stages, ocp.dynamics.sx_in()
    costate, multiplier = ca.SX.sym("lambda", ocp.state.size), ca.SX.sym("m", ocp.state.size)
    weighted = ocp.stage_cost(s, u, theta)[0] + ca.dot(costate, ocp.dynamics(s, u, theta))
    slopes = [ca.densify(ca.gradient(weighted, s) + multiplier), ca.densify(ca.gradient(weighted, u))]
    backward = ca.Function("fpirhc_backward_stage", [costate, s, u, theta, multiplier], slopes)
    slope = ca.densify(ca.gradient(ocp.terminal_cost(s, theta), s))
    end = ca.Function("fpirhc_terminal_gradient", [s, theta], [slope])
    s0, inputs, data = _symbols(ocp)
    multipliers = ca.MX.sym("M", ocp.state.size, n)
    states, total, _ = rollout(ocp)(s0, inputs, data)
    last = end(states[:, n], data[:, n]) + multipliers[:, n - 1]
    # Stage 0 has no state multiplier: its state is given.
    stage_multipliers = ca.horzcat(ca.MX.zeros(ocp.state.size, 1), multipliers[:, : n - 1])
    order = list(range(n - 1, -1, -1))
    sweep = backward.mapaccum("fpirhc_adjoint_stages", n)
    costates, gradient = sweep(last, states[:, order], inputs[:, order], data[:, order], stage_multipliers[:, order])
    results = [total, gradient[:, order], states, ca.horzcat(costates[:, order], last)]
    names = ["V", "g", "S", "costates"]
    return ca.Function("fpirhc_gradient", [s0, inputs, data, multipliers], results, ["s0", "U", "data", "M"], names)


def _symbols(ocp: OptimalControl) -> tuple[ca.MX, ca.MX, ca.MX]:
    sizes = {"s0": (ocp.state.size, 1), "U": (ocp.input.size, ocp.stages), "data": (ocp.data.size, ocp.stages + 1)}
    s0, inputs, data = (ca.MX.sym(name, *size) for name, size in sizes.items())
    return s0, inputs, data
