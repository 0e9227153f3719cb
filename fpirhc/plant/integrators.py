"""Integrators: the plant's state one control cycle later, with the command held. Theory: docs/theory.md.

Runge-Kutta 4, and collocation with a fixed number of Newton steps, are plain expressions, so they can be compiled and
exported.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast, final

import casadi as ca
import numpy as np

from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import FEW, Few
from fpirhc.plant.maps import by_single_steps
from fpirhc.plant.motion import sampling
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression

_NAMES = ["x", "u", "p", "w"], ["x_next"]


@dataclass(frozen=True)
class Integrator(Checked, ABC):
    """Contract: how x' = f(x, u, p, w) moves in a time, in equal sub-steps. A map has steps of its own, and no use for it."""

    substeps: Few = 1

    @abstractmethod
    def method(self, rate: ca.Function, h: float) -> Callable[..., Expression]:
        """Function (x, u, p, w) -> x after one sub-step of length h, of one with the same arguments -> dx/dt."""

    def finer(self, times: int) -> Integrator | None:
        """The same method with so many times the sub-steps; None where these were too many."""
        more = self.substeps * times
        return replace(self, substeps=more) if more <= FEW else None

    def growth(self, modes: np.ndarray) -> np.ndarray | None:
        """Return |R(z)|, by which a cycle multiplies a mode whose pole times period is z, per mode, by sub-steps of x' = z x.

        None: no decaying mode ever grows, as in implicit methods.
        """
        once: Any = self.method(cast(ca.Function, lambda x: modes * x), 1 / self.substeps)
        return np.asarray(np.abs(once(1.0)) ** self.substeps)

    @final
    def integrate(self, rate: ca.Function, period: float) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state after `period`, of one with the same arguments -> dx/dt."""
        x, u, p, w = _symbols(rate)
        once, after = self.method(rate, period / self.substeps), x
        for _ in range(self.substeps):
            after = once(after, u, p, w)
        return ca.Function("fpirhc_moved", [x, u, p, w], [after], *_NAMES)

    @final
    def step(self, plant: Plant, period: float) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state after `period`, in the plant's unit of time."""
        if plant.step is None:
            return self.integrate(plant.equations.forced_rate, period)
        x, u, p, w = _symbols(plant.equations.next)
        after = x
        for _ in range(max(1, round(period / sampling(plant)))):
            after = plant.equations.next(after, u, p, w)
        return ca.Function("fpirhc_map", [x, u, p, w], [after], *_NAMES)

    @final
    def stretched(self, plant: Plant, step: float, longest: float) -> ca.Function:
        """Function (state, input, parameters, length) -> state after so many steps at once, up to the longest."""
        (x, u, p), length, still = plant.symbols(), ca.SX.sym("length"), ca.SX.zeros(len(plant.names))
        if plant.step is None:  # one step of f times the length
            rate = plant.equations.forced_rate
            *_, w = _symbols(rate)
            given = [x, u, ca.vertcat(p, length), w]
            slow = ca.Function("fpirhc_slow", given, [length * rate(x, u, p, w)], _NAMES[0], ["dx"])
            after = self.integrate(slow, step)(*given[:3], still)
        else:
            one, after = self.step(plant, step), x
            for k in range(round(longest)):
                later = one(after, u, p, still)
                after = ca.if_else(length > k, later, after) if k else later
        return ca.Function("fpirhc_stretched", [x, u, p, length], [after])


class RungeKutta4(Integrator):
    """Classical fourth-order Runge-Kutta with so many equal sub-steps per cycle: local error O(h^5), global O(h^4)."""

    def method(self, rate: ca.Function, h: float) -> Callable[..., Expression]:
        def once(x: Expression, *given: Expression) -> Expression:
            k1 = rate(x, *given)
            k2 = rate(x + h / 2 * k1, *given)
            k3 = rate(x + h / 2 * k2, *given)
            k4 = rate(x + h * k3, *given)
            return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

        return once


@dataclass(frozen=True)
class Collocation(Integrator):
    """Collocation at Radau points, of order 2 d - 1: for plants with modes much faster than the step. None of them ever grows.

        x_j = x + h sum_k a_jk f(x_k, u, p),   j = 1 ... d,   x+ = x_d

    by a fixed number of Newton steps on all x_j together, from x_j = x. The linear systems are factorised as sparse ones (QR), so
    work grows with the states as their coupling does: for a rod of cells in proportion.

    Args:
        substeps: equal sub-steps per step.
        degree: number of points d in a sub-step.
        newton: Newton steps per sub-step; one is exact where the plant is linear.

    Raises:
        InvalidField: fewer than one of any.
    """

    degree: Few = 2
    newton: Few = 3

    def growth(self, modes: np.ndarray) -> None:
        """No decaying mode grows."""

    def method(self, rate: ca.Function, h: float) -> Callable[..., Expression]:
        x, u, p, w = _symbols(rate)
        n, d = x.numel(), self.degree
        # x_j' = sum_k slopes_kj x_k / h of the polynomial through x and all x_k; the first row belongs to x.
        slopes = np.asarray(ca.collocation_coeff(ca.collocation_points(d, "radau"))[0])
        points = ca.SX.sym("points", n, d)
        rates = ca.horzcat(*(rate(points[:, j], u, p, w) for j in range(d)))
        left = ca.vec(ca.mtimes(ca.horzcat(x, points), ca.DM(slopes)) - h * rates)
        change = ca.qr_solve(left, *ca.qr_sparse(ca.jacobian(left, ca.vec(points))), False)
        newton = ca.cse(ca.reshape(ca.vec(points) - change, n, d))
        better = ca.Function("fpirhc_newton", [x, points, u, p, w], [newton])

        def once(x: Expression, *given: Expression) -> Expression:
            inside = ca.repmat(x, 1, d)
            for _ in range(self.newton):
                inside = better(x, inside, *given)
            return inside[:, d - 1]

        return once


def own_steps(plant: Plant, integrator: Integrator, period: float) -> int:
    """Return how many steps of its own a plant makes in a cycle: those of a map, sub-steps, and else one."""
    return round(period / plant.step) if plant.step is not None else integrator.substeps


def own_step(plant: Plant, integrator: Integrator, period: float) -> ca.Function:
    """Return the Function of one of these steps, as `Integrator.step`."""
    count = own_steps(plant, integrator, period)
    return replace(integrator, substeps=1).step(by_single_steps(plant), period / count)


USUAL = RungeKutta4()
"""The integrator of a problem, or of a horizon, that names none."""


def _symbols(rate: ca.Function) -> tuple[ca.SX, ...]:
    return tuple(ca.SX.sym(rate.name_in(k), rate.size1_in(k)) for k in range(4))


def spurious_growth(
    plant: Plant,
    integrator: Integrator,
    period: float,
    states: np.ndarray,
    commands: np.ndarray,
    parameters: np.ndarray,
) -> np.ndarray:
    """Return the largest factor by which steps at some points, one per column, make a decaying mode grow, shape (N,); 1: none."""
    x, u, p = plant.symbols()
    slope = ca.Function("fpirhc_slope", [x, u, p], [ca.densify(ca.jacobian(plant.equations.rate(x, u, p), x))])
    largest = np.ones(states.shape[1])
    for k, (state, command) in enumerate(zip(states.T, commands.T, strict=True)):
        slopes = np.asarray(slope(state, command, parameters).full())
        if plant.step is None and np.isfinite(slopes).all():
            modes = np.linalg.eigvals(slopes)  # per unit of time
            growth, decays = integrator.growth(modes * period), modes.real <= 1e-9 * np.abs(modes)
            largest[k] = 1.0 if growth is None else growth[decays].max(initial=1.0)
    return largest
