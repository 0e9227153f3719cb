"""Integrators: the plant's state one control cycle later, with the command held.

Runge-Kutta 4 with sub-steps is made of plain expressions, so it can be compiled and exported. CVODES controls its own
error and is the reference that the fixed-step one is judged by; it stays in CasADi's virtual machine.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from fpirhc.errors import InvalidValue
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression


class Integrator(ABC):
    """Contract: one cycle of the plant as a Function."""

    @property
    def opaque(self) -> bool:
        """Whether the step holds operations that scalar expressions cannot."""
        return False

    def finer(self, times: int) -> Integrator | None:  # noqa: ARG002
        """The same method with about that many times the work; None where it has no such setting."""
        return None

    @abstractmethod
    def step(self, plant: Plant, period: float) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state after `period` seconds."""


@dataclass(frozen=True)
class RungeKutta4(Integrator):
    """Classical fourth-order Runge-Kutta with equal sub-steps: local error O(h^5), global O(h^4)."""

    substeps: int = 1

    def __post_init__(self) -> None:
        if self.substeps < 1:
            raise InvalidValue(f"RungeKutta4 needs at least 1 sub-step, got {self.substeps}")

    def finer(self, times: int) -> RungeKutta4:
        """With that many times the sub-steps."""
        return RungeKutta4(self.substeps * times)

    def step(self, plant: Plant, period: float) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state after `period` seconds."""
        rate = plant.forced_derivative_function
        x, u, p, w = (ca.SX.sym(rate.name_in(k), rate.size1_in(k)) for k in range(4))
        h = period / self.substeps
        following = x
        for _ in range(self.substeps):
            following = runge_kutta_4(lambda s: rate(s, u, p, w), following, h)
        return ca.Function("fpirhc_rk4", [x, u, p, w], [following], ["x", "u", "p", "w"], ["x_next"])


@dataclass(frozen=True)
class Euler(Integrator):
    """Explicit Euler in one step: x+ = x + h f(x, u). First order, for horizons in the manner of the original papers."""

    def step(self, plant: Plant, period: float) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state after `period` seconds."""
        rate = plant.forced_derivative_function
        x, u, p, w = (ca.SX.sym(rate.name_in(k), rate.size1_in(k)) for k in range(4))
        following = x + period * rate(x, u, p, w)
        return ca.Function("fpirhc_euler", [x, u, p, w], [following], ["x", "u", "p", "w"], ["x_next"])


@dataclass(frozen=True)
class Cvodes(Integrator):
    """SUNDIALS CVODES with the given relative and absolute tolerance."""

    tolerance: float = 1e-10

    @property
    def opaque(self) -> bool:
        """CVODES is called, not written out."""
        return True

    def finer(self, times: int) -> Cvodes:  # noqa: ARG002
        """With a tenth of the tolerance."""
        return Cvodes(self.tolerance / 10)

    def step(self, plant: Plant, period: float) -> ca.Function:
        """Function (state, input, parameters, forcing) -> state after `period` seconds."""
        rate = plant.forced_derivative_function
        x, u, p, w = (ca.SX.sym(rate.name_in(k), rate.size1_in(k)) for k in range(4))
        given = ca.vertcat(u, p, w)
        options = {"reltol": self.tolerance, "abstol": self.tolerance}
        solver = ca.integrator(
            "fpirhc_cvodes", "cvodes", {"x": x, "p": given, "ode": rate(x, u, p, w)}, 0.0, period, options
        )
        xm, um, pm, wm = (ca.MX.sym(rate.name_in(k), rate.size1_in(k)) for k in range(4))
        following = solver(x0=xm, p=ca.vertcat(um, pm, wm))["xf"]
        return ca.Function("fpirhc_cvodes_step", [xm, um, pm, wm], [following], ["x", "u", "p", "w"], ["x_next"])


def runge_kutta_4(rate: Callable[[Expression], Expression], x: Expression, h: float) -> Expression:
    """Return x after one classical Runge-Kutta step of length h for x' = rate(x)."""
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    k4 = rate(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
