"""Nonlinear programming through CasADi by direct multiple shooting: IPOPT and fatrop.

    variables    w = (s_0, u_0, s_1, ..., u_{N-1}, s_N),    constraints  s_{i+1} - F(s_i, u_i) = 0,

Solvers judge what is small by absolute numbers, so they see every variable, constraint and the cost in a unit of its own size.
Theory: docs/theory.md.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from fpirhc.fields.kinds import Accuracy, Count, Positive
from fpirhc.horizon.problem import OptimalControl, rollout
from fpirhc.optimisers import (
    UNKNOWN_ITERATIONS,
    Optimiser,
    call_arguments,
    clip,
    judge,
    refuse_limits,
    remembered_plan,
    sane,
    scales,
    shift,
    state_units,
    state_violation,
    status_of,
)
from fpirhc.status import Status
from fpirhc.symbolic.expression import is_finite
from fpirhc.symbolic.layout import Layout, Signal

Setting: TypeAlias = "bool | int | float | str | Sequence[bool] | ca.Function | Mapping[str, Setting]"
Options: TypeAlias = Mapping[str, Setting]
_LARGEST_MULTIPLIER = 1e12


@dataclass(frozen=True)
class MultipleShooting(Optimiser):
    """What all solvers share: the program, the warm start, and the judgement."""

    tolerance: Positive = 1e-3  # of the stationarity, in the unit of the inputs, below which a plan is converged

    @property
    @abstractmethod
    def plugin(self) -> str:
        """CasADi's name of the solver."""

    @abstractmethod
    def options(self, ocp: OptimalControl) -> Options:
        """CasADi's options of the solver."""

    def check(self, ocp: OptimalControl) -> None:
        """Raise if limits of states have prices."""
        refuse_limits(self, ocp, "prices")

    def memory(self, ocp: OptimalControl) -> Layout:
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
        parts = self.memory(ocp).split(memory)
        states, inputs = separate(ocp, parts["plan_variable_multipliers"])
        dynamics = ca.reshape(parts["plan_dynamics_multipliers"], ocp.state.size, ocp.stages)
        shifted_parts = {
            "plan_inputs": ca.vec(shift(ca.reshape(parts["plan_inputs"], ocp.input.size, ocp.stages), ocp)),
            "plan_variable_multipliers": interleave(shift(states, ocp), shift(inputs, ocp)),
            "plan_dynamics_multipliers": ca.vec(shift(dynamics, ocp)),
        }
        return self.memory(ocp).join(shifted_parts)

    def step(self, ocp: OptimalControl) -> ca.Function:
        """Function (s0, data, lower, upper, memory) -> (U, diagnostics, memory).

        Solvers misbehave on numbers that are not finite, so they are not called when the arguments, or the program at its
        first guess, are not.
        """
        s0, data, lower, upper, _ = arguments = call_arguments(ocp, self.memory(ocp).size)
        start, states = self._guess(ocp)(*arguments)
        begin = _program_values(ocp, by := units(ocp))(interleave(states, start) / by.variables, ca.vec(data))
        usable = ca.logic_and(sane(s0, data, lower, upper), is_finite(begin))
        run, skip = self._solve(ocp, "fpirhc_shooting"), self._skip(ocp)
        results = ca.Function.if_else("fpirhc_guarded_shooting", run, skip)(usable, *arguments)
        return ca.Function("fpirhc_shooting_step", arguments, list(results))

    def _skip(self, ocp: OptimalControl) -> ca.Function:
        """The remembered plan, with status NON_FINITE (INFEASIBLE for an empty box) and forgotten multipliers."""
        layout = self.memory(ocp)
        _, _, lower, upper, memory = arguments = call_arguments(ocp, self.memory(ocp).size)
        start = remembered_plan(layout.split(memory)["plan_inputs"], ocp.input.size, lower, upper)
        status = ca.if_else(ca.mmax(lower - upper) > 0, int(Status.INFEASIBLE), int(Status.NON_FINITE))
        diagnostics = ca.vertcat(ca.MX.zeros(3), UNKNOWN_ITERATIONS, status)
        forgotten = {name: ca.MX.zeros(layout[name].size) for name in layout.names}
        next_memory = layout.join({**forgotten, "plan_inputs": ca.vec(start)})
        return ca.Function("fpirhc_shooting_skip", arguments, [start, diagnostics, next_memory])

    def _guess(self, ocp: OptimalControl) -> ca.Function:
        """Function of the step's arguments -> (U, S): the remembered plan, or one that the model survives."""
        s0, data, lower, upper, memory = arguments = call_arguments(ocp, self.memory(ocp).size)
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
        s0, data, lower, upper, memory = arguments = call_arguments(ocp, self.memory(ocp).size)
        remembered = layout.split(memory)
        start, states = self._guess(ocp)(*arguments)
        solution = scaled_solver("fpirhc_shooting_solver", self.plugin, ocp, self.options(ocp))(
            x0=interleave(states, start),
            p=ca.vec(data),
            lbx=interleave(_stage_bounds(ocp, s0, ocp.state_lower), ca.repmat(lower, 1, n)),
            ubx=interleave(_stage_bounds(ocp, s0, ocp.state_upper), ca.repmat(upper, 1, n)),
            lbg=0,
            ubg=0,
            lam_x0=remembered["plan_variable_multipliers"],
            lam_g0=remembered["plan_dynamics_multipliers"],
        )
        inputs = clip(separate(ocp, solution["x"])[1], lower, upper)
        multipliers = separate(ocp, solution["lam_x"])[0][:, 1:] * int(ocp.bounds_states)
        cost, residual, violation = judge(ocp.measured_at_rest)(inputs, s0, data, lower, upper, multipliers)
        finite = is_finite(ca.vertcat(ca.vec(inputs), cost, residual, violation, solution["lam_x"], solution["lam_g"]))
        plan = ca.if_else(finite, inputs, start)
        numbers = ca.if_else(finite, ca.vertcat(cost, residual, violation), ca.MX.zeros(3))
        counts = state_violation(ocp, rollout(ocp)(s0, inputs, data)[0], state_units(ocp))
        status = status_of(finite, residual, counts, self.tolerance)
        next_parts = {
            "plan_inputs": ca.vec(plan),
            # A solve that was not finite must not poison the next warm start.
            "plan_variable_multipliers": ca.if_else(finite, solution["lam_x"], 0),
            "plan_dynamics_multipliers": ca.if_else(finite, solution["lam_g"], 0),
        }
        diagnostics = ca.vertcat(numbers, UNKNOWN_ITERATIONS, status)
        return ca.Function(name, arguments, [plan, diagnostics, layout.join(next_parts)])


def _usable(multipliers: ca.MX) -> ca.MX:
    """Forget multipliers that are not finite or absurdly large: they would poison a warm start."""
    return ca.if_else(ca.fabs(multipliers) <= _LARGEST_MULTIPLIER, multipliers, 0)


def _program_values(ocp: OptimalControl, by: Units) -> ca.Function:
    """Function (w, p) -> cost, constraints and their first derivatives in one column."""
    nlp = program(ocp, by)
    slopes = ca.gradient(nlp["f"], nlp["x"]), ca.jacobian(nlp["g"], nlp["x"])
    column = ca.vertcat(nlp["f"], nlp["g"], ca.densify(slopes[0]), ca.vec(slopes[1].nz[:]))
    return ca.Function("fpirhc_program_values", [nlp["x"], nlp["p"]], [column])


def sizes(ocp: OptimalControl) -> tuple[int, int]:
    """Return the numbers of variables and of constraints."""
    return ocp.stages * (ocp.state.size + ocp.input.size) + ocp.state.size, ocp.stages * ocp.state.size


def interleave(states: ca.MX, inputs: ca.MX) -> ca.MX:
    """Return states (ns, N + 1) and inputs (nu, N) as a column (s_0, u_0, s_1, ..., s_N)."""
    n = inputs.shape[1]
    return ca.vertcat(ca.vec(ca.vertcat(states[:, :n], inputs)), states[:, n])


def separate(ocp: OptimalControl, column: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return states (ns, N + 1) and inputs (nu, N) of a column: the inverse of `interleave`."""
    ns, nu, n = ocp.state.size, ocp.input.size, ocp.stages
    stages = ca.reshape(column[: n * (ns + nu)], ns + nu, n)
    return ca.horzcat(stages[:ns, :], column[n * (ns + nu) :]), stages[ns:, :]


def _stage_bounds(ocp: OptimalControl, s0: ca.MX, bound: np.ndarray) -> ca.MX:
    """Return the bounds of s_0 ... s_N; the first state is fixed."""
    return ca.horzcat(s0, ca.repmat(ca.DM(bound), 1, ocp.stages))


class Units(NamedTuple):
    """What a program is divided by."""

    variables: ca.DM
    constraints: ca.DM
    cost: float


def units(ocp: OptimalControl) -> Units:
    """Return the units of `scales`, so that a program sees numbers of size one.

    A state without limits has at most the one that a unit of the inputs in all stages moves it by.
    """
    measures, n = scales(ocp), ocp.stages
    slopes = np.abs(ocp.along.sensitivity()).reshape(n, ocp.state.size, n, ocp.input.size)
    moved = n * (slopes.max(axis=(0, 2)) @ measures.inputs)
    small = ~np.isfinite(ocp.half_ranges) & (moved > 0) & (moved < measures.states)
    states, inputs = ca.DM(np.where(small, moved, measures.states)), ca.DM(measures.inputs)
    every = ca.vertcat(ca.repmat(ca.vertcat(states, inputs), n), states)
    return Units(every, ca.repmat(states, n), measures.cost)


def scaled_solver(name: str, plugin: str, ocp: OptimalControl, options: Options) -> ca.Function:
    """Return CasADi's `nlpsol` of the program, which sees it in units of `units`; what it takes and returns has those of `ocp`."""
    w, g, cost = by = units(ocp)
    made = ca.nlpsol(f"{name}_scaled", plugin, program(ocp, by), options)
    given = {key: ca.MX.sym(key, made.sparsity_in(key)) for key in made.name_in()}
    scaled = {**given, **{key: given[key] / w for key in ("x0", "lbx", "ubx")}}
    scaled |= {key: given[key] / g for key in ("lbg", "ubg")}
    scaled |= {key: _usable(given[key] * unit / cost) for key, unit in (("lam_x0", w), ("lam_g0", g))}
    found = made(**scaled)
    own: dict[str, ca.DM | float] = {"x": w, "g": g, "f": cost, "lam_x": cost / w, "lam_g": cost / g}
    results = [found[key] * own.get(key, 1.0) for key in made.name_out()]
    return ca.Function(name, list(given.values()), results, made.name_in(), made.name_out())


def program(ocp: OptimalControl, by: Units) -> dict[str, ca.MX]:
    """Return the program as CasADi's `nlpsol` takes it, divided by its units, with the data of all stages as its parameter."""
    n = ocp.stages
    w, flat = ca.MX.sym("w", sizes(ocp)[0]), ca.MX.sym("p", ocp.data.size * (n + 1))
    states, inputs = separate(ocp, w * by.variables)
    data = ca.reshape(flat, ocp.data.size, n + 1)
    costs, _ = ocp.stage_cost.map(n)(states[:, :n], inputs, data[:, :n])
    value = ca.sum2(costs) + ocp.terminal_cost(states[:, n], data[:, n])
    next_states = ocp.dynamics.map(n)(states[:, :n], inputs, data[:, :n])
    return {"x": w, "p": flat, "f": value / by.cost, "g": ca.vec(states[:, 1:] - next_states) / by.constraints}


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
    time_limit: Positive | None = None

    @property
    def unbounded(self) -> str:
        return "" if self.time_limit else "IPOPT has no time limit here: give Ipopt(time_limit=...), in s"

    plugin = "ipopt"

    def options(self, ocp: OptimalControl) -> Options:  # noqa: ARG002
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

    unbounded = (
        "fatrop has no time limit, and after an outlier its call may never return: use FixedPointSolver(), "
        "or Ipopt(time_limit=...)"
    )

    plugin = "fatrop"

    def options(self, ocp: OptimalControl) -> Options:
        return {
            **_QUIET,
            "structure_detection": "auto",
            "equality": [True] * (ocp.stages * ocp.state.size),
            "fatrop": {"print_level": 0, "tol": self.accuracy, "max_iter": self.iterations, "mu_init": 1e-2},
        }


EXAMPLES = (Ipopt(tolerance=1e-6), Fatrop(tolerance=1e-6))
