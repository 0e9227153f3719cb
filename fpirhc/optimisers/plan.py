"""Open-loop solves: a plan as numbers, which can verify itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import ByName, checked_call
from fpirhc.horizon.problem import OptimalControl, reduced_gradient, rollout
from fpirhc.optimisers import Optimiser, feasible_to, first_plan, improved, judge, tolerated
from fpirhc.status import Status
from fpirhc.summary import line, number
from fpirhc.symbolic.expression import TINY

_WORST = 5  # violations in a text
_AT_BOUND = 1e-6  # relative distance within which an input counts as at its bound


@dataclass(frozen=True, eq=False)
class Plan:
    """A solved horizon.

    Args:
        inputs: U, shape (nu, N).
        states: X, shape (ns, N + 1).
        cost: V; None where the status is NON_FINITE, because what was tried has no such number.
        stationarity: as defined in `fpirhc.optimisers`; None like the cost.
        feasibility: as defined there; None like the cost.
        iterations: of the optimiser; -1: not known.
        calls: of the optimiser's step.
        status: of the plan.
        problem: the problem that was solved.
        data: its data, shape (ntheta, N + 1).
    """

    inputs: np.ndarray
    states: np.ndarray
    cost: float | None
    stationarity: float | None
    feasibility: float | None
    iterations: float
    calls: int
    status: Status
    problem: OptimalControl
    data: np.ndarray

    def __repr__(self) -> str:
        return line(self, self.status.name, *(f"{name} {value}" for name, value in self._facts()))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits of the inputs, shape (nu,) each."""
        return self.problem.input_lower, self.problem.input_upper

    def _facts(self) -> list[tuple[str, str]]:
        """The numbers that sum up the plan, by name."""
        steps = f"{self.iterations:g}" if self.iterations >= 0 else "unknown"
        return [
            ("cost", _shown(self.cost, lambda v: f"{v:.7g}")),
            ("stationarity", _shown(self.stationarity, number)),
            ("feasibility", _shown(self.feasibility, number)),
            ("stages", _stages(self.problem)),
            ("iterations", f"{steps} in {self.calls} calls"),
        ]

    @cached_property
    def state_multipliers(self) -> np.ndarray:
        """Multipliers of the state bounds, shape (ns, N), fitted to the plan alone, without its optimiser."""
        return _fit_multipliers(self.problem, self.inputs, self.states[:, 0], self.data)

    def violations(self) -> tuple[str, ...]:
        """Return the five worst violations of state bounds in words, the first state first; empty when there are none."""
        ocp, violations = self.problem, []
        most = tolerated(ocp)
        for k, (name, unit) in enumerate(zip(ocp.state.elements, ocp.state.units, strict=True)):
            low, high = ocp.state_lower[k], ocp.state_upper[k]
            for stage, value in enumerate(self.states[k]):
                if not np.isfinite(value):
                    continue  # `overflow` names it
                by = max(low - value, value - high)
                means_something = stage > 0 or k < ocp.state.size - ocp.written
                if by > most[k] and means_something and ocp.hard[k]:
                    side, end = ("below", low) if value < low else ("above", high)
                    limit, far = _apart(end, by), _apart(value, by)
                    violations.append((stage > 0, -by, f"'{name}' is {far} {unit}, {side} {limit}, at stage {stage}"))
        return tuple(text for _, _, text in sorted(violations)[:_WORST])

    def overflow(self) -> str:
        """Return where the plan stops being finite: the state, input or cost term and its stage, in words; empty when nowhere."""
        ocp = self.problem
        for stage in range(ocp.stages + 1):
            for names, values in ((ocp.state.elements, self.states), (ocp.input.elements, self.inputs)):
                column = values[:, min(stage, values.shape[1] - 1)]
                bad = np.flatnonzero(~np.isfinite(column))
                if bad.size:
                    return f"'{names[bad[0]]}' is {column[bad[0]]} at stage {stage}"
            if stage < ocp.stages:
                arguments = self.states[:, stage], self.inputs[:, stage], self.data[:, stage]
                terms = np.asarray(ocp.stage_cost(*arguments)[1].full()).ravel()
                bad = np.flatnonzero(~np.isfinite(terms))
                if bad.size:
                    return f"cost term '{ocp.terms[bad[0]]}' is {terms[bad[0]]} at stage {stage}"
        final = float(ocp.terminal_cost(self.states[:, ocp.stages], self.data[:, ocp.stages]))
        return "" if np.isfinite(final) else f"the terminal cost is {final} at stage {ocp.stages}"

    def slacks(self) -> dict[str, float]:
        """Return what was paid for every priced limit over the horizon by name, zero where it is kept."""
        ocp, prices = self.problem, dict[str, float]()
        for k in np.flatnonzero(~ocp.hard).tolist():
            row = self.states[k, 1:]
            beyond = np.maximum(row - ocp.state_upper[k], 0) + np.maximum(ocp.state_lower[k] - row, 0)
            prices[ocp.state.elements[k]] = float(ocp.state_price[k] * beyond.sum())
        return ByName(prices, "Plan.slacks()")

    def verify(self) -> tuple[float, float, float]:
        """Return (cost, stationarity, feasibility), recomputed from the problem's own functions."""
        ocp = self.problem
        numbers = judge(ocp)(self.inputs, self.states[:, 0], self.data, *self.bounds, self.state_multipliers)
        cost, stationarity, feasibility = (float(v) for v in numbers)
        return cost, stationarity, feasibility


@checked_call
def solve(
    ocp: OptimalControl,
    optimiser: Optimiser,
    state: np.ndarray,
    data: np.ndarray,
    *,
    calls: int = 50,
    start: np.ndarray | None = None,
) -> Plan:
    """Solve one horizon open loop: call the optimiser's step until its status is OK, at most `calls` times.

    A plan that violates a state bound is improved further as long as the violation shrinks.

    Args:
        ocp: the problem.
        optimiser: the optimiser.
        state: s_0, shape (ns,).
        data: shape (ntheta, N + 1).
        calls: most calls of the optimiser's step.
        start: first inputs, shape (nu, N); None: zero, and the middle of the limits where that ends at limits only.

    Raises:
        NotSupported: the optimiser cannot serve the problem.
        InvalidValue: a state, data or first inputs of another shape, or numbers of them that are not finite.
    """
    optimiser.check(ocp)
    state = _checked("state", state, (ocp.state.size,))
    data = _checked("data", data, (ocp.data.size, ocp.stages + 1))
    if start is not None:
        start = _checked("start", start, (ocp.input.size, ocp.stages))
    if start is None:
        inputs, diagnostics, _, count = first_plan(optimiser, ocp, state, data, calls=calls)
    else:
        layout = optimiser.memory(ocp)
        memory = layout.start()
        memory[layout.slice("plan_inputs")] = start.ravel(order="F")
        inputs, diagnostics, _, count = improved(optimiser, ocp, state, data, memory, calls=calls)
    states = np.asarray(rollout(ocp)(state, inputs, data)[0].full())
    status = Status(int(diagnostics[4]))
    cost, residual, violation = (float(v) if status != Status.NON_FINITE else None for v in diagnostics[:3])
    given = np.asarray(ca.DM(data).full())
    return Plan(inputs, states, cost, residual, violation, float(diagnostics[3]), count, status, ocp, given)


def _checked(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The value as an array of this shape, which a column may have in place of a vector."""
    array = np.asarray(value.full() if isinstance(value, ca.DM) else value, dtype=float)
    if array.shape not in (shape, (*shape, 1)):
        raise InvalidValue(f"solve: {name} has the shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise InvalidValue(f"solve: {name} is not finite")
    return array.reshape(shape)


def _apart(value: float, by: float) -> str:
    """Return a number with so many digits that another one is seen to be so far from it."""
    digits = 2 + math.ceil(math.log10(max(abs(value) / by, 1.0)))
    return f"{value:.{min(max(digits, 6), 17)}g}"


def _stages(ocp: OptimalControl) -> str:
    lengths = np.diff(ocp.node_times)
    ends = dict.fromkeys(f"{v:g}" for v in (lengths.min(), lengths.max()))
    return f"{ocp.stages} of {' to '.join(ends)} {ocp.time_unit}"


def _shown(value: float | None, text: Callable[[float], str]) -> str:
    return "none" if value is None else text(value)


def _fit_multipliers(ocp: OptimalControl, inputs: np.ndarray, state: np.ndarray, data: np.ndarray) -> np.ndarray:
    """The multipliers M (ns, N) of state bounds, each with the sign of its bound; zero where no state is at a bound.

    At a solution g + (dS/dU)' M = 0 in every input that is not at its own bound: a non-negative least-squares problem.
    """
    none = np.zeros((ocp.state.size, ocp.stages))
    if not ocp.bounds_states:
        return none
    slope, states, sensitivity = (np.asarray(v.full()) for v in sensitivity_of(ocp)(state, inputs, data))
    flat = states[:, 1:].ravel(order="F")
    upper = flat >= np.tile(ocp.state_upper - feasible_to(ocp), ocp.stages)
    lower = flat <= np.tile(ocp.state_lower + feasible_to(ocp), ocp.stages)
    near, least, most = _AT_BOUND * (1 + np.abs(inputs)), ocp.input_lower[:, None], ocp.input_upper[:, None]
    free = ~((inputs <= least + near) | (inputs >= most - near)).ravel(order="F")
    # Rows in the units of the stationarity, so that the fit weighs what is judged.
    weight = np.tile(ocp.scale, ocp.stages)[free]
    columns = weight[:, None] * sensitivity.T[free]
    signed = np.hstack([columns[:, upper], -columns[:, lower]])
    if not signed.size or not np.isfinite(sensitivity).all():
        return none  # no state at a bound, or no input that could leave it
    from scipy.optimize import nnls

    size = np.maximum(np.linalg.norm(signed, axis=0), TINY)
    weights, _ = nnls(signed / size, -weight * slope.ravel(order="F")[free])
    fitted = np.zeros(upper.size)
    fitted[upper] += (weights / size)[: upper.sum()]
    fitted[lower] -= (weights / size)[upper.sum() :]
    return fitted.reshape(none.shape, order="F")


def sensitivity_of(ocp: OptimalControl) -> ca.Function:
    """Return the Function (s0, U, data) -> (g, S, d vec(s_1 ... s_N) / d vec(U))."""
    s0, data = ca.MX.sym("s0", ocp.state.size), ca.MX.sym("data", ocp.data.size, ocp.stages + 1)
    inputs = ca.MX.sym("U", ocp.input.size, ocp.stages)
    states, _, _ = rollout(ocp)(s0, inputs, data)
    slope = reduced_gradient(ocp)(s0, inputs, data, ca.MX.zeros(ocp.state.size, ocp.stages))[1]
    sensitivity = ca.jacobian(ca.vec(states[:, 1:]), ca.vec(inputs))
    return ca.Function("fpirhc_sensitivity", [s0, inputs, data], [slope, states, ca.densify(sensitivity)])
