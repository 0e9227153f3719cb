"""Nonlinear programming through CasADi by direct multiple shooting: IPOPT, fatrop, and SQP with OSQP or qrqp.

    variables    w = (s_0, u_0, s_1, ..., u_{N-1}, s_N),    constraints  s_{i+1} - F(s_i, u_i) = 0,

warm-started with the shifted last plan, its rolled-out states, and its multipliers. A solver's own status is not used: the plan is
judged by an adjoint gradient of this package, with the solver's multipliers of state bounds, and by rolling it out.

References: J. A. E. Andersson et al., CasADi, Math. Program. Comput. 11, 2019.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Accuracy, Count, Positive
from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.multiple_shooting import MultipleShooting, Options, gauss_newton_hessian

_OSQP_BOUNDED = 2000  # iterations that are a bound of time on a machine
_QUIET: Options = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False}


@dataclass(frozen=True)
class Ipopt(MultipleShooting):
    """IPOPT: the interior-point method that most tools use by default.

    Args:
        tolerance: of the stationarity, in the unit of the inputs.
        accuracy: IPOPT's own tolerance.
        iterations: most iterations of IPOPT in one call.
        time_limit: most time of one call, s; None: no limit.
    """

    accuracy: Accuracy = 1e-8
    iterations: Count = 200
    time_limit: Positive | None = field(default=None, metadata={"setting": "where given"})

    @property
    def unbounded(self) -> str:
        """Without a time limit its restoration phase may take long."""
        return "" if self.time_limit else "IPOPT has no time limit here: give Ipopt(time_limit=...), in s"

    @property
    def plugin(self) -> str:
        """CasADi's name of the solver."""
        return "ipopt"

    def options(self, ocp: OptimalControl) -> Options:  # noqa: ARG002
        """Quiet, with a warm start."""
        return {
            **_QUIET,
            "ipopt.sb": "yes",
            "ipopt.print_level": 0,
            "ipopt.tol": self.accuracy,
            "ipopt.max_iter": self.iterations,
            "ipopt.warm_start_init_point": "yes",
            "ipopt.warm_start_bound_push": 1e-9,
            "ipopt.warm_start_mult_bound_push": 1e-9,
            "ipopt.mu_init": 1e-4,
            **({} if self.time_limit is None else {"ipopt.max_wall_time": self.time_limit}),
        }


@dataclass(frozen=True)
class Fatrop(MultipleShooting):
    """fatrop: an interior-point method that exploits the stages of the horizon.

    Args:
        tolerance: of the stationarity, in the unit of the inputs.
        accuracy: fatrop's own tolerance.
        iterations: most iterations of fatrop in one call.
    """

    accuracy: Accuracy = 1e-8
    iterations: Count = 200

    @property
    def unbounded(self) -> str:
        """It has no time limit, and some samples make it iterate for ever."""
        return (
            "fatrop has no time limit, and after an outlier its call may never return: use FixedPoint(), "
            "or Ipopt(time_limit=...)"
        )

    @property
    def plugin(self) -> str:
        """CasADi's name of the solver."""
        return "fatrop"

    def options(self, ocp: OptimalControl) -> Options:
        """Quiet, with the stages detected."""
        return {
            **_QUIET,
            "structure_detection": "auto",
            "equality": [True] * (ocp.stages * ocp.state.size),
            "fatrop": {"print_level": 0, "tol": self.accuracy, "max_iter": self.iterations, "mu_init": 1e-2},
        }


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


@dataclass(frozen=True)
class SequentialQuadratic(MultipleShooting):
    """Gauss-Newton SQP: the cost's own second derivatives, the dynamics linearised.

    Args:
        tolerance: of the stationarity, in the unit of the inputs.
        quadratic: solves the programs inside. CasADi's interfaces to fatrop and hpipm are not among them: the first has returned
            infeasible points marked as solved, the second needs finite bounds on everything.
        iterations: of SQP per call; 1 is a real-time iteration.
    """

    quadratic: QuadraticSolver = field(default_factory=Qrqp)
    iterations: Count = 20

    @property
    def unbounded(self) -> str:
        """As its quadratic solver."""
        return self.quadratic.unbounded

    @property
    def plugin(self) -> str:
        """CasADi's name of the solver."""
        return "sqpmethod"

    def options(self, ocp: OptimalControl) -> Options:
        """With the Gauss-Newton Hessian, which is positive semi-definite for convex stage costs."""
        return {
            **_QUIET,
            "print_header": False,
            "print_iteration": False,
            "print_status": False,
            "qpsol": self.quadratic.plugin,
            "qpsol_options": self.quadratic.options(),
            "max_iter": self.iterations,
            "tol_pr": 1e-8,
            "tol_du": 1e-8,
            "min_step_size": 1e-12,
            "hess_lag": gauss_newton_hessian(ocp),
        }


EXAMPLES = (
    Ipopt(tolerance=1e-6),
    Fatrop(tolerance=1e-6),
    SequentialQuadratic(tolerance=1e-6),
    SequentialQuadratic(tolerance=1e-6, quadratic=Osqp()),
)
CHOICES = {
    "ipopt": ("IPOPT", lambda tolerance: Ipopt(tolerance=tolerance)),
    "fatrop": ("fatrop", lambda tolerance: Fatrop(tolerance=tolerance)),
    "qrqp": ("SQP qrqp", lambda tolerance: SequentialQuadratic(tolerance=tolerance)),
    "osqp": ("SQP OSQP", lambda tolerance: SequentialQuadratic(tolerance=tolerance, quadratic=Osqp())),
    "osqp-rti": (
        "OSQP, one iteration",
        lambda tolerance: SequentialQuadratic(tolerance=tolerance, quadratic=Osqp(), iterations=1),
    ),
}
