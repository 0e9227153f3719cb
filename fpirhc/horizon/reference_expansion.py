"""The quadratic model of a horizon's cost along the reference, and the scales that follow from it.

    c_k = (1 / step) d^2 V / d u_0k^2   with the dynamics linearised along the reference (Gauss-Newton),

so that g_k / (step c_k) has the unit of the input whatever the units and the weights of the cost are.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

_POWER_STEPS = 50
_MARGIN = 1.1  # a power iteration approaches the eigenvalue from below


@dataclass(frozen=True, eq=False)
class ReferenceExpansion:
    """The quadratic model, stage by stage.

    Args:
        a: A, shape (N, ns, ns).
        b: B, shape (N, ns, nu).
        q: Q, shape (N, ns, ns).
        s: S, shape (N, nu, ns).
        r: R, shape (N, nu, nu).
        final: Q of the end, shape (ns, ns).
    """

    a: np.ndarray
    b: np.ndarray
    q: np.ndarray
    s: np.ndarray
    r: np.ndarray
    final: np.ndarray

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

    def hessian(self) -> np.ndarray:
        """Return M (N nu, N nu), the Hessian of V with the dynamics linearised."""
        stages, _, nu = self.b.shape
        columns = np.eye(stages * nu).reshape(-1, stages, nu)
        return np.array([self.hessian_times(column).ravel() for column in columns])

    def growth(self) -> np.ndarray:
        """Largest factor |eigenvalue of dF/ds| by which a motion grows in each stage, shape (N,)."""
        return np.array([np.abs(np.linalg.eigvals(a)).max() if np.isfinite(a).all() else np.nan for a in self.a])

    def least_curvature(self) -> float:
        """Smallest eigenvalue of a stage's cost Hessian, relative to its largest."""
        blocks = np.block([[self.q, self.s.transpose(0, 2, 1)], [self.s, self.r]])
        values = np.linalg.eigvalsh(blocks)
        ends = np.linalg.eigvalsh(self.final)
        size = max(np.abs(values).max(), np.abs(ends).max(), 1e-300)
        return float(min(values.min(), ends.min()) / size)


def expand_along(
    dynamics: ca.Function,
    stage_cost: ca.Function,
    terminal_cost: ca.Function,
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray],
    functions: dict[object, ca.Function] | None = None,
) -> ReferenceExpansion:
    """Return the quadratic model along a trajectory.

    Args:
        dynamics: (s, u, theta) -> s_next.
        stage_cost: (s, u, theta) -> (l, terms).
        terminal_cost: (s, theta) -> T.
        nodes: states (ns, N + 1), inputs (nu, N) and data (ntheta, N + 1).
        functions: keeps the Functions of derivatives for the next call; None: they are built.
    """
    functions = {} if functions is None else functions
    if "linearised" not in functions:
        functions |= {"linearised": _linearised(dynamics, stage_cost), "final": _final(terminal_cost)}
    states, inputs, data = nodes
    stages = inputs.shape[1]
    linearised = functions["linearised"]
    derivatives = [
        [np.asarray(v.full()) for v in linearised(states[:, i], inputs[:, i], data[:, i])] for i in range(stages)
    ]
    final = np.asarray(functions["final"](states[:, stages], data[:, stages]).full())
    a, b, q, s, r = (np.array([stage[k] for stage in derivatives]) for k in range(5))
    return ReferenceExpansion(a, b, q, s, r, final)


def input_curvature(along: ReferenceExpansion, step: float) -> np.ndarray:
    """Return c (nu,), positive.

    An input without curvature gets the largest curvature of the others, or 1 where no input has one.
    """
    slope, total = along.b[0], along.r[0].diagonal().copy()
    for a, q in zip(along.a[1:], along.q[1:], strict=True):
        total += np.einsum("ik,ij,jk->k", slope, q, slope)
        slope = a @ slope
    total = np.abs(total + np.einsum("ik,ij,jk->k", slope, along.final, slope)) / step
    usable = np.isfinite(total) & (total > 0)
    return np.where(usable, total, total[usable].max() if usable.any() else 1.0)


def steepest_curvature(along: ReferenceExpansion, scale: np.ndarray) -> float:
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
    s, u, theta = (ca.SX.sym(n, dynamics.size1_in(k)) for k, n in enumerate(("s", "u", "theta")))
    next_state, cost = dynamics(s, u, theta), stage_cost(s, u, theta)[0]
    slope = ca.gradient(cost, u)
    second = [ca.hessian(cost, s)[0], ca.jacobian(slope, s), ca.jacobian(slope, u)]
    results = [ca.jacobian(next_state, s), ca.jacobian(next_state, u), *second]
    return ca.Function("fpirhc_linearised", [s, u, theta], [ca.densify(r) for r in results])


def _final(terminal_cost: ca.Function) -> ca.Function:
    """Function (s, theta) -> d2T/ds2."""
    s, theta = (ca.SX.sym(n, terminal_cost.size1_in(k)) for k, n in enumerate(("s", "theta")))
    return ca.Function("fpirhc_final", [s, theta], [ca.densify(ca.hessian(terminal_cost(s, theta), s)[0])])
