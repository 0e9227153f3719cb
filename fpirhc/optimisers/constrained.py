"""State bounds for an optimiser of input bounds: its step on the augmented problem, then one update of the multipliers.

A call of `step` makes one update, so a controller improves the multipliers from cycle to cycle, as it improves the plan; an
open-loop solve repeats calls until the plan is stationary and inside its bounds.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from fpirhc.horizon.augmented import augmented, bounded_states, updated_multipliers
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.rollout import rollout
from fpirhc.optimisers.base import FINITE, is_finite, judge, sane, shift, status_of
from fpirhc.status import Status
from fpirhc.symbolic.layout import Expression, Layout, Signal

MULTIPLIERS = "plan_state_multipliers"


def with_multipliers(ocp: OptimalControl, inner: Layout) -> Layout:
    """The inner optimiser's memory and the multipliers of s_1 ... s_N."""
    names = [ocp.state.elements[k] for k in bounded_states(ocp)]
    return inner + Layout((Signal(MULTIPLIERS, tuple(f"{s}@{k}" for k in range(1, ocp.stages + 1) for s in names)),))


def shifted_multipliers(ocp: OptimalControl, column: Expression) -> Expression:
    """The multipliers one stage later."""
    return ca.vec(shift(ca.reshape(column, len(bounded_states(ocp)), ocp.stages)))


def constrained_step(
    ocp: OptimalControl,
    build: Callable[[OptimalControl], ca.Function],
    inner: Layout,
    tolerance: float,
    feasible: float,
) -> ca.Function:
    """Return the step (s0, data, lower, upper, memory) -> (U, diagnostics, memory) around `build(augmented problem)`."""
    nu, n, rows = ocp.input.size, ocp.stages, len(bounded_states(ocp))
    layout = with_multipliers(ocp, inner)
    s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, n + 1)
    lower, upper, memory = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu), ca.MX.sym("memory", layout.size)
    kept = layout.split(memory)
    usable = ca.if_else(ca.fabs(kept[MULTIPLIERS]) <= FINITE, kept[MULTIPLIERS], 0)
    before = ca.reshape(usable, rows, n)
    extended = ca.vertcat(data, ca.horzcat(ca.MX.zeros(rows, 1), before))
    given = inner.join({name: kept[name] for name in inner.names})
    plan, told, following = build(augmented(ocp))(s0, extended, lower, upper, given)
    states = rollout(ocp)(s0, plan, data)[0]
    found = updated_multipliers(ocp)(states, before)
    cost, residual, violation = judge(ocp)(plan, s0, data, lower, upper, _all_states(ocp, found))
    finite = ca.logic_and(
        ca.logic_and(sane(s0, data, lower, upper), told[4] < int(Status.NON_FINITE)),
        is_finite(ca.vertcat(cost, residual, violation, ca.vec(found))),
    )
    status = status_of(finite, residual, violation, tolerance)
    inside = ca.if_else(violation <= feasible, status, ca.fmax(status, int(Status.NOT_CONVERGED)))
    judged = ca.if_else(told[4] == int(Status.INFEASIBLE), told[4], inside)
    numbers = ca.if_else(finite, ca.vertcat(cost, residual, violation), ca.MX.zeros(3))
    remembered = layout.join({**inner.split(following), MULTIPLIERS: ca.if_else(finite, ca.vec(found), 0)})
    diagnostics = ca.vertcat(numbers, told[3], judged)
    return ca.Function("fpirhc_constrained", [s0, data, lower, upper, memory], [plan, diagnostics, remembered])


def _all_states(ocp: OptimalControl, found: ca.MX) -> ca.MX:
    """Multipliers (ns, N) with zeros where nothing is bounded."""
    rows = [ca.MX.zeros(1, ocp.stages) for _ in range(ocp.state.size)]
    for row, k in enumerate(bounded_states(ocp)):
        rows[k] = found[row, :]
    return ca.vertcat(*rows)
