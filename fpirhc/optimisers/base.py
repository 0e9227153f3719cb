"""The contract of optimisers, and how every plan is judged.

A plan's stationarity is measured by our own adjoint gradient g, never by a solver's word:

    stationarity = max |U - clip(U - g / (step c), lower, upper)|,

how far, in the units of the inputs, a scaled projected gradient step would move some input. c is the curvature of the cost
rate along each input (`OptimalControl.curvature`), so that the number does not depend on the units of the cost. It is zero
exactly at points that satisfy the first-order conditions, bounds active or not. A multiplier of a state bound counts only where
the state is at that bound and with the sign of that bound. Feasibility is the largest violation of a state bound by the rolled
out plan (inputs are inside their box by construction).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.rollout import reduced_gradient, rollout
from fpirhc.status import Status
from fpirhc.symbolic.expression import Matrix
from fpirhc.symbolic.layout import Layout

FINITE = 1e300  # |v| <= FINITE is false for NaN and infinity
FEASIBLE = 1e-4  # largest violation of a state bound that still counts as kept
UNKNOWN_ITERATIONS = -1.0  # solver call-outs do not tell their iterations inside a graph


class Optimiser(ABC):
    """Contract: one improvement of a warm-started plan as a Function, with a fixed amount of work where possible."""

    @property
    def exportable(self) -> bool:
        """Whether the step can leave CasADi's virtual machine as C code."""
        return True

    @property
    def unbounded(self) -> str:
        """Why a call may take any time, with a remedy; empty where its work is bounded."""
        return ""

    @property
    def logged(self) -> Mapping[str, str]:
        """Scalars of the memory that a run logs: signal -> name in the memory."""
        return {}

    def check(self, ocp: OptimalControl) -> None:  # noqa: B027 -- most optimisers serve every problem
        """Raise NotSupported when the problem has something this optimiser cannot keep."""

    @abstractmethod
    def memory(self, ocp: OptimalControl) -> Layout:
        """What is kept for the next call: at least the plan, in `plan_inputs`."""

    @abstractmethod
    def shifted(self, ocp: OptimalControl, memory: ca.MX) -> ca.MX:
        """The memory for a horizon that starts one stage later."""

    @abstractmethod
    def step(self, ocp: OptimalControl) -> ca.Function:
        """Function (s0, data, lower, upper, memory) -> (U (nu, N), diagnostics, memory for the next call).

        diagnostics: cost, stationarity, feasibility, iterations, status. A plan that is not finite is never returned: the
        remembered one is, with status NON_FINITE.
        """

    def converging(self, ocp: OptimalControl) -> ca.Function:
        """Like `step`, but may stop as soon as the plan is converged, and may work longer: for open-loop solves."""
        return self.step(ocp)

    def rescue(self, ocp: OptimalControl) -> ca.Function | None:  # noqa: ARG002
        """Function (arguments of `converging`, its results) -> better results, for calls that do not end OK; or None."""
        return None

    def first_memory(self, ocp: OptimalControl, state: np.ndarray, data: np.ndarray) -> np.ndarray:  # noqa: ARG002
        """Memory to begin a run with, for a first horizon that is known beforehand; nothing unless an optimiser says otherwise."""
        return self.memory(ocp).start()


def require_settings(owner: str, iterations: int, tolerance: float) -> None:
    """Check what every iterative optimiser is given.

    Raises:
        InvalidValue: fewer than one iteration, or a tolerance that is not positive.
    """
    if iterations < 1:
        raise InvalidValue(f"{owner} needs at least 1 iteration, got {iterations}")
    if not tolerance > 0:
        raise InvalidValue(f"{owner} needs a positive tolerance, got {tolerance}")


def shift(columns: ca.MX) -> ca.MX:
    """Drop the first stage and repeat the last: the warm start of the next call."""
    return columns if columns.shape[1] == 1 else ca.horzcat(columns[:, 1:], columns[:, -1])


def clip(columns: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
    """Clip every stage's input to its box."""
    stages = columns.shape[1]
    return ca.fmin(ca.fmax(columns, ca.repmat(lower, 1, stages)), ca.repmat(upper, 1, stages))


def is_finite(value: Matrix) -> Matrix:
    """1 when every entry is finite, 0 otherwise (NaN included, which fmax and fmin would hide)."""
    return ca.mmin(ca.fabs(ca.vec(value)) <= FINITE)


def largest(value: ca.MX) -> ca.MX:
    """Largest absolute entry."""
    return ca.norm_inf(ca.vec(value))


def stationarity(ocp: OptimalControl, inputs: ca.MX, gradient: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
    """Return the projected residual of a plan (see the module's docstring)."""
    scale = ca.repmat(ca.DM(1 / (ocp.step * ocp.curvature)), 1, ocp.stages)
    return largest(inputs - clip(inputs - scale * gradient, lower, upper))


def state_violation(ocp: OptimalControl, states: ca.MX) -> ca.MX:
    """Largest violation of a hard state bound by s_1 ... s_N; zero without bounds."""
    worst: ca.MX = ca.MX(0)
    for k in np.flatnonzero(ocp.hard).tolist():
        row = states[k, 1:]
        if ocp.state_lower[k] > -FINITE:
            worst = ca.fmax(worst, ca.mmax(ocp.state_lower[k] - row))
        if ocp.state_upper[k] < FINITE:
            worst = ca.fmax(worst, ca.mmax(row - ocp.state_upper[k]))
    return worst


def judge(ocp: OptimalControl) -> ca.Function:
    """Function (U, s0, data, lower, upper, M) -> (cost, stationarity, feasibility), by our own sweeps.

    M (ns, N) are the multipliers of the state bounds; zero without them.
    """
    inputs, data = ca.MX.sym("U", ocp.input.size, ocp.stages), ca.MX.sym("data", ocp.data.size, ocp.stages + 1)
    s0, lower, upper = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("l", ocp.input.size), ca.MX.sym("u", ocp.input.size)
    multipliers = ca.MX.sym("M", ocp.state.size, ocp.stages)
    valid = multipliers
    if ocp.bounds_states:
        valid = _valid_multipliers(ocp, rollout(ocp)(s0, inputs, data)[0], multipliers)
    value, slope, states, _ = reduced_gradient(ocp)(s0, inputs, data, valid)
    results = [value, stationarity(ocp, inputs, slope, lower, upper), state_violation(ocp, states)]
    return ca.Function("fpirhc_judge", [inputs, s0, data, lower, upper, multipliers], results)


def _valid_multipliers(ocp: OptimalControl, states: ca.MX, multipliers: ca.MX) -> ca.MX:
    """Keep what can be a multiplier: positive at the upper bound, negative at the lower one, zero elsewhere."""
    rows = []
    for k in range(ocp.state.size):
        row, given = states[k, 1:], multipliers[k, :]
        at_upper = row >= ocp.state_upper[k] - FEASIBLE if ocp.state_upper[k] < FINITE else ca.MX.zeros(1, ocp.stages)
        at_lower = row <= ocp.state_lower[k] + FEASIBLE if ocp.state_lower[k] > -FINITE else ca.MX.zeros(1, ocp.stages)
        kept = ca.if_else(at_upper, ca.fmax(given, 0), 0) + ca.if_else(at_lower, ca.fmin(given, 0), 0)
        # fmax and fmin would hide NaN.
        rows.append(kept + ca.if_else(ca.fabs(given) <= FINITE, 0, given))
    return ca.vertcat(*rows)


def sane(s0: ca.MX, data: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
    """1 when a problem can be posed: finite first state and data, and a box that is not empty; 0 otherwise (NaN included)."""
    ordered = ca.logic_and(ca.mmin(lower <= upper), ca.logic_and(ca.mmin(lower <= FINITE), ca.mmin(upper >= -FINITE)))
    return ca.logic_and(is_finite(ca.vertcat(s0, ca.vec(data))), ordered)


def remembered_plan(column: ca.MX, size: int, lower: ca.MX, upper: ca.MX) -> ca.MX:
    """The remembered plan (size, N) inside its box; a poisoned memory is forgotten, for zero inputs."""
    usable = ca.if_else(is_finite(column), column, 0)
    return clip(ca.reshape(usable, size, column.numel() // size), lower, upper)


def status_of(finite: Matrix, residual: Matrix, violation: Matrix | float, tolerance: float) -> Matrix:
    """Return the status number of a plan."""
    converged = ca.if_else(residual <= tolerance, int(Status.OK), int(Status.NOT_CONVERGED))
    feasible = ca.if_else(violation <= FEASIBLE, converged, int(Status.INFEASIBLE))
    return ca.if_else(finite, feasible, int(Status.NON_FINITE))
