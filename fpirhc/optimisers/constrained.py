"""State bounds for an optimiser of input bounds: its step on the augmented problem, and updates of the multipliers.

One call alternates a few times between the inner step and an update of the multipliers, which are remembered and shifted like the
plan. An update counts only where the inner plan is nearly stationary: multipliers of an unfinished plan would drive the next
one away. An open-loop solve repeats calls until the plan is stationary and inside its bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import casadi as ca

from fpirhc.horizon.augmented_lagrangian import augmented, bounded_states, updated_multipliers
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.rollout import rollout
from fpirhc.optimisers.base import FINITE, is_finite, judge, sane, shift, state_violation, status_of
from fpirhc.status import Status
from fpirhc.symbolic.layout import Layout, Signal, scalar

MULTIPLIERS = "plan_state_multipliers"
_RHO, _VIOLATION = "plan_penalty", "plan_violation"
_ENOUGH = 0.1  # share of the violation that an update may leave before rho is raised
_RAISE, _LARGEST = 5.0, 1e4
_NEARLY = 0.05  # stationarity, relative to the largest input, up to which multipliers are believed


def with_multipliers(ocp: OptimalControl, inner: Layout) -> Layout:
    """The inner optimiser's memory, the multipliers of s_1 ... s_N, rho - 1, and the violation after the last update."""
    names = [ocp.state.elements[k] for k in bounded_states(ocp)]
    multipliers = Signal(MULTIPLIERS, tuple(f"{s}@{k}" for k in range(1, ocp.stages + 1) for s in names))
    return inner + Layout((multipliers, scalar(_RHO), scalar(_VIOLATION)))


def shifted_multipliers(ocp: OptimalControl, kept: Mapping[str, ca.MX]) -> dict[str, ca.MX]:
    """What belongs to the multipliers, one stage later: rho relaxes, and the last violation says nothing any more."""
    return {
        MULTIPLIERS: ca.vec(shift(ca.reshape(kept[MULTIPLIERS], len(bounded_states(ocp)), ocp.stages))),
        _RHO: kept[_RHO] / _RAISE,
        _VIOLATION: ca.MX(0),
    }


def constrained_step(
    ocp: OptimalControl,
    build: Callable[[OptimalControl], ca.Function],
    inner: Layout,
    prepare: Callable[[dict[str, ca.MX], ca.MX], dict[str, ca.MX]],
    updates: int,
    tolerance: float,
    feasible: float,
) -> ca.Function:
    """Return the step (s0, data, lower, upper, memory) -> (U, diagnostics, memory) around `build(augmented problem)`.

    `prepare` makes the inner memory fit a problem that is rho times as steep.
    """
    nu, n, rows = ocp.input.size, ocp.stages, len(bounded_states(ocp))
    layout, work, update = with_multipliers(ocp, inner), build(augmented(ocp)), updated_multipliers(ocp)
    s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, n + 1)
    lower, upper, memory = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu), ca.MX.sym("memory", layout.size)
    kept = layout.split(memory)
    usable = ca.if_else(ca.fabs(kept[MULTIPLIERS]) <= FINITE, kept[MULTIPLIERS], 0)
    found: ca.MX = ca.reshape(usable, rows, n)
    rho = 1 + ca.if_else(ca.fabs(kept[_RHO]) <= _LARGEST, ca.fabs(kept[_RHO]), 0)
    worst: ca.MX = ca.if_else(ca.fabs(kept[_VIOLATION]) <= FINITE, kept[_VIOLATION], 0)
    given, iterations = {name: kept[name] for name in inner.names}, ca.MX(0)
    for _ in range(updates):
        before = found
        extended = ca.vertcat(data, ca.repmat(rho, 1, n + 1), ca.horzcat(ca.MX.zeros(rows, 1), before))
        plan, told, after = work(s0, extended, lower, upper, inner.join(prepare(given, rho)))
        given, states = inner.split(after), rollout(ocp)(s0, plan, data)[0]
        fresh, left = update(states, rho, before), state_violation(ocp, states)
        settled = told[1] <= 10 * tolerance + _NEARLY * ca.norm_inf(ca.vec(plan))
        trusted = ca.logic_and(settled, is_finite(ca.vec(fresh)))
        slow = ca.logic_and(ca.logic_and(trusted, worst > 0), left > ca.fmax(_ENOUGH * worst, feasible))
        found, worst = ca.if_else(trusted, fresh, before), ca.if_else(trusted, left, worst)
        rho, iterations = ca.if_else(slow, ca.fmin(_RAISE * rho, _LARGEST), rho), iterations + told[3]
    cost, residual, violation = judge(ocp)(plan, s0, data, lower, upper, _all_states(ocp, fresh))
    finite = ca.logic_and(
        ca.logic_and(sane(s0, data, lower, upper), told[4] < int(Status.NON_FINITE)),
        is_finite(ca.vertcat(cost, residual, violation, ca.vec(fresh))),
    )
    status = status_of(finite, residual, violation, tolerance)
    inside = ca.if_else(violation <= feasible, status, ca.fmax(status, int(Status.NOT_CONVERGED)))
    judged = ca.if_else(told[4] == int(Status.INFEASIBLE), told[4], inside)
    numbers = ca.if_else(finite, ca.vertcat(cost, residual, violation), ca.MX.zeros(3))
    own = {MULTIPLIERS: ca.vec(found), _RHO: rho - 1, _VIOLATION: worst}
    remembered = layout.join({**given, **{name: ca.if_else(finite, value, 0) for name, value in own.items()}})
    diagnostics = ca.vertcat(numbers, iterations, judged)
    return ca.Function("fpirhc_constrained", [s0, data, lower, upper, memory], [plan, diagnostics, remembered])


def _all_states(ocp: OptimalControl, found: ca.MX) -> ca.MX:
    """Multipliers (ns, N) with zeros where nothing is bounded."""
    rows = [ca.MX.zeros(1, ocp.stages) for _ in range(ocp.state.size)]
    for row, k in enumerate(bounded_states(ocp)):
        rows[k] = found[row, :]
    return ca.vertcat(*rows)
