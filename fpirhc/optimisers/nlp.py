"""Nonlinear programming through CasADi by direct multiple shooting: IPOPT, fatrop, and SQP with OSQP or qrqp.

    variables    w = (s_0, u_0, s_1, ..., u_{N-1}, s_N),    constraints  s_{i+1} - F(s_i, u_i) = 0,

warm-started with the shifted last plan, its rolled-out states, and its multipliers. A solver's own word of success is not used: the
plan is judged by our adjoint gradient, with the solver's multipliers of state bounds, and by rolling it out.

References: J. A. E. Andersson et al., CasADi, Math. Program. Comput. 11, 2019.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi as ca

from fpirhc.errors import InvalidValue, NotSupported, nearest
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.rollout import rollout
from fpirhc.optimisers.base import (
    UNKNOWN_ITERATIONS,
    Optimiser,
    clip,
    is_finite,
    judge,
    remembered_plan,
    sane,
    shift,
    status_of,
)
from fpirhc.optimisers.shooting import (
    gauss_newton_hessian,
    interleave,
    program,
    program_values,
    separate,
    shift_dynamics,
    shift_variables,
    sizes,
    stage_bounds,
)
from fpirhc.status import Status
from fpirhc.symbolic.layout import Layout, Signal

Setting: TypeAlias = "bool | int | float | str | Sequence[bool] | ca.Function | Mapping[str, Setting]"
Options: TypeAlias = Mapping[str, Setting]
_QUIET: Options = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False}
_LARGEST_MULTIPLIER = 1e12
_OSQP_BOUNDED = 2000  # iterations that are a bound of time on a machine


@dataclass(frozen=True)
class QuadraticSolver(ABC):
    """Contract: a solver of the quadratic programs inside SequentialQuadratic."""

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
    """CasADi's own active-set solver on a sparse QR factorisation."""

    iterations: int = 200

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
        accuracy: that OSQP is asked for.
        iterations: that it may use for one quadratic program. CasADi passes no time limit on.

    Raises:
        InvalidValue: fewer than one iteration.
    """

    accuracy: float = 1e-8
    iterations: int = 20000

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise InvalidValue(f"Osqp needs at least 1 iteration, got {self.iterations}")

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
        NotSupported: CasADi has the solver, but it returns wrong answers here (the reason is given).
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


@dataclass(frozen=True)
class _MultipleShooting(Optimiser):
    """What all backends share: the program, the warm start, and the judgement."""

    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if not self.tolerance > 0:
            raise InvalidValue(f"{type(self).__name__} needs a positive tolerance, got {self.tolerance}")

    @property
    @abstractmethod
    def plugin(self) -> str:
        """CasADi's name of the solver."""

    @abstractmethod
    def options(self, ocp: OptimalControl) -> Options:
        """CasADi's options of the solver."""

    @property
    def exportable(self) -> bool:
        """Solver libraries are called, not written out."""
        return False

    def check(self, ocp: OptimalControl) -> None:
        """Raise if limits have a price.

        Raises:
            NotSupported: they would be kept as hard ones.
        """
        if not ocp.hard.all():
            names = ", ".join(e for e, hard in zip(ocp.state.elements, ocp.hard, strict=True) if not hard)
            raise NotSupported(
                f"{type(self).__name__} keeps limits or weighs them (soft), but takes no prices ({names}); use FixedPoint()"
            )

    def memory(self, ocp: OptimalControl) -> Layout:
        """The plan, and the multipliers of variables and constraints."""
        variables, constraints = sizes(ocp)
        plan = tuple(f"{i}@{k}" for k in range(ocp.stages) for i in ocp.input.elements)
        return Layout(
            (
                Signal("plan_inputs", plan),
                Signal("plan_variable_multipliers", tuple(map(str, range(variables)))),
                Signal("plan_dynamics_multipliers", tuple(map(str, range(constraints)))),
            )
        )

    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        """The plan and the multipliers one stage later."""
        kept = self.memory(ocp).split(memory)
        moved = {
            "plan_inputs": ca.vec(shift(ca.reshape(kept["plan_inputs"], ocp.input.size, ocp.stages))),
            "plan_variable_multipliers": shift_variables(ocp, kept["plan_variable_multipliers"]),
            "plan_dynamics_multipliers": shift_dynamics(ocp, kept["plan_dynamics_multipliers"]),
        }
        return self.memory(ocp).join(moved)

    def step(self, ocp: OptimalControl) -> ca.Function:
        """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory).

        Solvers misbehave on numbers that are not finite, so they are not called when the arguments, or the program at its
        first guess, are not.
        """
        s0, data, lower, upper, _ = arguments = self._arguments(ocp)
        start, states = self._guess(ocp)(*arguments)
        begin = program_values(ocp)(interleave(states, start), ca.vec(data))
        usable = ca.logic_and(sane(s0, data, lower, upper), is_finite(begin))
        run, skip = self._solve(ocp, "fpirhc_shooting"), self._skip(ocp)
        results = ca.Function.if_else("fpirhc_guarded_shooting", run, skip)(usable, *arguments)
        return ca.Function("fpirhc_shooting_step", arguments, list(results))

    def _arguments(self, ocp: OptimalControl) -> list[ca.MX]:
        ns, nu = ocp.state.size, ocp.input.size
        shapes = {"s0": (ns, 1), "data": (ocp.data.size, ocp.stages + 1), "lower": (nu, 1), "upper": (nu, 1)}
        symbols = [ca.MX.sym(name, *shape) for name, shape in shapes.items()]
        return [*symbols, ca.MX.sym("memory", self.memory(ocp).size)]

    def _skip(self, ocp: OptimalControl) -> ca.Function:
        """The remembered plan, with status NON_FINITE (INFEASIBLE for an empty box) and forgotten multipliers."""
        layout = self.memory(ocp)
        _, _, lower, upper, memory = arguments = self._arguments(ocp)
        start = remembered_plan(layout.split(memory)["plan_inputs"], ocp.input.size, lower, upper)
        status = ca.if_else(ca.mmax(lower - upper) > 0, int(Status.INFEASIBLE), int(Status.NON_FINITE))
        diagnostics = ca.vertcat(ca.MX.zeros(3), UNKNOWN_ITERATIONS, status)
        forgotten = {name: ca.MX.zeros(layout[name].size) for name in layout.names}
        kept = layout.join({**forgotten, "plan_inputs": ca.vec(start)})
        return ca.Function("fpirhc_shooting_skip", arguments, [start, diagnostics, kept])

    def _guess(self, ocp: OptimalControl) -> ca.Function:
        """Function of the step's arguments -> (U, S): the remembered plan, or one that the model survives."""
        s0, data, lower, upper, memory = arguments = self._arguments(ocp)
        plan = remembered_plan(self.memory(ocp).split(memory)["plan_inputs"], ocp.input.size, lower, upper)
        still = clip(ca.MX.zeros(ocp.input.size, ocp.stages), lower, upper)
        survives = is_finite(rollout(ocp)(s0, plan, data)[0])
        start = ca.if_else(survives, plan, still)
        states, _, _ = rollout(ocp)(s0, start, data)
        # An unstable model may overflow under any open-loop plan; standing still is then the better first guess.
        guess = ca.if_else(is_finite(states), states, ca.repmat(s0, 1, ocp.stages + 1))
        return ca.Function("fpirhc_shooting_guess", arguments, [start, guess])

    def _solve(self, ocp: OptimalControl, name: str) -> ca.Function:
        n, layout = ocp.stages, self.memory(ocp)
        s0, data, lower, upper, memory = arguments = self._arguments(ocp)
        kept = layout.split(memory)
        start, states = self._guess(ocp)(*arguments)
        solution = ca.nlpsol("fpirhc_shooting_solver", self.plugin, program(ocp), self.options(ocp))(
            x0=interleave(states, start),
            p=ca.vec(data),
            lbx=interleave(stage_bounds(ocp, s0, ocp.state_lower), ca.repmat(lower, 1, n)),
            ubx=interleave(stage_bounds(ocp, s0, ocp.state_upper), ca.repmat(upper, 1, n)),
            lbg=0,
            ubg=0,
            lam_x0=_usable(kept["plan_variable_multipliers"]),
            lam_g0=_usable(kept["plan_dynamics_multipliers"]),
        )
        found = clip(separate(ocp, solution["x"])[1], lower, upper)
        multipliers = separate(ocp, solution["lam_x"])[0][:, 1:] * int(ocp.bounds_states)
        cost, residual, violation = judge(ocp)(found, s0, data, lower, upper, multipliers)
        finite = is_finite(ca.vertcat(ca.vec(found), cost, residual, violation, solution["lam_x"], solution["lam_g"]))
        plan = ca.if_else(finite, found, start)
        told = ca.if_else(finite, ca.vertcat(cost, residual, violation), ca.MX.zeros(3))
        status = status_of(finite, residual, violation, self.tolerance)
        following = {
            "plan_inputs": ca.vec(plan),
            # A solve that was not finite must not poison the next warm start.
            "plan_variable_multipliers": ca.if_else(finite, solution["lam_x"], 0),
            "plan_dynamics_multipliers": ca.if_else(finite, solution["lam_g"], 0),
        }
        diagnostics = ca.vertcat(told, UNKNOWN_ITERATIONS, status)
        return ca.Function(name, arguments, [plan, diagnostics, layout.join(following)])


@dataclass(frozen=True)
class Ipopt(_MultipleShooting):
    """IPOPT: the interior-point method that most tools use by default.

    Parameters: tolerance of our stationarity, in the unit of the inputs; accuracy that IPOPT is asked for; iterations it may use;
    time_limit of one call in s, None for none.
    """

    accuracy: float = 1e-8
    iterations: int = 200
    time_limit: float | None = None

    def __post_init__(self) -> None:
        _MultipleShooting.__post_init__(self)
        _check_time_limit("Ipopt", self.time_limit)

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
class Fatrop(_MultipleShooting):
    """fatrop: an interior-point method that exploits the stages of the horizon."""

    accuracy: float = 1e-8
    iterations: int = 200

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
class SequentialQuadratic(_MultipleShooting):
    """Gauss-Newton SQP: the cost's own second derivatives, the dynamics linearised.

    Parameters: `quadratic` solves the programs inside; `iterations` of SQP per call (1 is a real-time iteration).
    """

    quadratic: QuadraticSolver = field(default_factory=Qrqp)
    iterations: int = 20

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


def _check_time_limit(owner: str, limit: float | None) -> None:
    if limit is not None and not 0 < limit < float("inf"):
        raise InvalidValue(f"{owner}(time_limit={limit!r}): expected a positive number of seconds, or None")


def _usable(multipliers: ca.MX) -> ca.MX:
    """Forget multipliers that are not finite or absurdly large: they would poison a warm start."""
    return ca.if_else(ca.fabs(multipliers) <= _LARGEST_MULTIPLIER, multipliers, 0)


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
