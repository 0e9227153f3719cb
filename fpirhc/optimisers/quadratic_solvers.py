"""Solvers of the quadratic programs of `SequentialQuadratic`, and the types of CasADi's options."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca

from fpirhc.errors import InvalidValue, NotSupported, nearest
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Accuracy, Count

Setting: TypeAlias = "bool | int | float | str | Sequence[bool] | ca.Function | Mapping[str, Setting]"
Options: TypeAlias = Mapping[str, Setting]
_OSQP_BOUNDED = 2000  # iterations that are a bound of time on a machine


@dataclass(frozen=True)
class QuadraticSolver(Checked, ABC):
    """Contract: a solver of the quadratic programs inside `SequentialQuadratic`."""

    @property
    @abstractmethod
    def plugin(self) -> str:
        """CasADi's name of the solver."""

    @abstractmethod
    def options(self) -> Options:
        """CasADi's options of the solver."""

    @property
    def unbounded(self) -> str:
        """Why a call may take any time, with a remedy; empty where its work is bounded."""
        return ""


@dataclass(frozen=True)
class Qrqp(QuadraticSolver):
    """CasADi's own active-set solver on a sparse QR factorisation.

    Args:
        iterations: most iterations of one program.
    """

    iterations: Count = 200

    @property
    def plugin(self) -> str:
        """CasADi's name of the solver."""
        return "qrqp"

    def options(self) -> Options:
        """Quiet, with an iteration limit."""
        quiet = {"print_iter": False, "print_header": False, "print_info": False, "print_lincomb": False}
        return {**quiet, "max_iter": self.iterations, "error_on_fail": False}


@dataclass(frozen=True)
class Osqp(QuadraticSolver):
    """OSQP, an operator-splitting method.

    Args:
        accuracy: of both residuals.
        iterations: most iterations of one quadratic program. CasADi passes no time limit on.
    """

    accuracy: Accuracy = 1e-8
    iterations: Count = 20000

    @property
    def plugin(self) -> str:
        """CasADi's name of the solver."""
        return "osqp"

    def options(self) -> Options:
        """Quiet, with the accuracy for both residuals and without polishing."""
        inner = {"verbose": False, "eps_abs": self.accuracy, "eps_rel": self.accuracy, "max_iter": self.iterations}
        return {"osqp": inner, "error_on_fail": False}

    @property
    def unbounded(self) -> str:
        """An infeasible program takes all iterations."""
        if self.iterations <= _OSQP_BOUNDED:
            return ""
        return (
            f"OSQP has no time limit, and an infeasible program takes all {self.iterations} iterations: "
            f"give Osqp(iterations=...), at most {_OSQP_BOUNDED}"
        )


def quadratic_solver(name: str) -> QuadraticSolver:
    """Return the named quadratic solver, for names that come from a command line.

    Raises:
        NotSupported: CasADi has the solver, but it returns wrong answers here; the message names the reason.
        InvalidValue: an unknown name.
    """
    if name in _REFUSED:
        raise NotSupported(f"quadratic solver '{name}' is refused: {_REFUSED[name]}. Use qrqp or osqp")
    known: dict[str, QuadraticSolver] = {"qrqp": Qrqp(), "osqp": Osqp()}
    if name not in known:
        raise InvalidValue(f"quadratic solver '{name}' is unknown.{nearest(name, known)}")
    return known[name]


_REFUSED = {
    "fatrop": "CasADi's conic interface to it has returned infeasible points marked as solved",
    "hpipm": "it needs finite bounds on everything",
}
