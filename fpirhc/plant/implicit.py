"""Implicit integrators with a fixed number of Newton steps, as plain expressions: for stiff plants, on horizons and in simulation.

Theory: docs/theory-plants.md.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.fields.kinds import Few
from fpirhc.plant.integrators import Integrator
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression

_Coefficients: TypeAlias = tuple[np.ndarray, np.ndarray]  # a (stages, stages) and b (stages,)


@dataclass(frozen=True)
class _Implicit(Integrator):
    """Sub-steps of one implicit method, each with a fixed number of Newton steps."""

    substeps: Few = 1
    newton: Few = 3

    @property
    @abstractmethod
    def _method(self) -> tuple[str, _Coefficients]:
        """Name of the Function, and the coefficients (a, b)."""

    def step(self, plant: Plant, period: float) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state after `period` seconds."""
        name, method = self._method
        return _step(name, plant, period, (self.substeps, self.newton), method)


@dataclass(frozen=True)
class ImplicitMidpoint(_Implicit):
    """Implicit midpoint rule: x+ = x + h k, k = f(x + h/2 k).

    Args:
        substeps: equal sub-steps per step.
        newton: Newton steps per sub-step.

    Raises:
        InvalidValue: fewer than one of either.
    """

    @property
    def _method(self) -> tuple[str, _Coefficients]:
        return "fpirhc_midpoint", (np.array([[0.5]]), np.array([1.0]))


@dataclass(frozen=True)
class RadauIIA(_Implicit):
    """Radau IIA with two stages, of order 3: for plants with modes much faster than the step.

    Args:
        substeps: equal sub-steps per step.
        newton: Newton steps per sub-step.

    Raises:
        InvalidValue: fewer than one of either.
    """

    @property
    def _method(self) -> tuple[str, _Coefficients]:
        return "fpirhc_radau", (np.array([[5 / 12, -1 / 12], [3 / 4, 1 / 4]]), np.array([3 / 4, 1 / 4]))


def _step(name: str, plant: Plant, period: float, counts: tuple[int, int], method: _Coefficients) -> ca.Function:
    rate, (substeps, newton) = plant.equations.forced_rate, counts
    x, u, p, w = (ca.SX.sym(rate.name_in(k), rate.size1_in(k)) for k in range(4))
    at, h = ca.SX.sym("at", x.numel()), period / substeps
    slope = ca.Function("fpirhc_slope", [at, u, p, w], [ca.densify(ca.jacobian(rate(at, u, p, w), at))])
    one = _implicit(lambda s: rate(s, u, p, w), lambda s: slope(s, u, p, w), x, h, method, newton)
    advance = ca.Function(name, [x, u, p, w], [ca.cse(one)], ["x", "u", "p", "w"], ["x_next"])
    next_state: Expression = x
    for _ in range(substeps):
        next_state = advance(next_state, u, p, w)
    return advance if substeps == 1 else ca.Function(name, [x, u, p, w], [next_state], ["x", "u", "p", "w"], ["x_next"])


def _implicit(
    rate: Callable[[Expression], Expression],
    slope: Callable[[Expression], Expression],
    x: Expression,
    h: float,
    method: _Coefficients,
    newton: int,
) -> Expression:
    """Return x after one step of the method with these coefficients."""
    (a, b), n = method, x.numel()
    stages = len(b)
    k = [ca.SX.zeros(n)] * stages
    for _ in range(newton):
        at = [x + h * sum((a[i, j] * k[j] for j in range(stages)), start=ca.SX.zeros(n)) for i in range(stages)]
        left = ca.vertcat(*(k[i] - rate(at[i]) for i in range(stages)))
        blocks = [[(i == j) * ca.SX.eye(n) - h * a[i, j] * slope(at[i]) for j in range(stages)] for i in range(stages)]
        newton_step = _solved(ca.densify(ca.vertcat(*(ca.horzcat(*row) for row in blocks))), left)
        k = [k[i] - newton_step[i * n : (i + 1) * n] for i in range(stages)]
    return x + h * sum((b[i] * k[i] for i in range(stages)), start=ca.SX.zeros(n))


def _solved(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Return matrix^-1 right by Gaussian elimination without pivoting.

    The matrices are near the identity or far from singular for every useful step.
    """
    n = right.numel()
    rows = [[matrix[i, j] for j in range(n)] + [right[i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [rows[i][j] - factor * rows[k][j] if j > k else rows[i][j] for j in range(n + 1)]
    solution: list[ca.SX] = []
    for i in reversed(range(n)):
        known = sum((rows[i][n - 1 - j] * solution[j] for j in range(len(solution))), start=ca.SX(0))
        solution.append((rows[i][n] - known) / rows[i][i])
    return ca.vertcat(*reversed(solution))
