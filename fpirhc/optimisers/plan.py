"""Open-loop solves: a plan as numbers, which can verify itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.by_name import ByName
from fpirhc.fields.checked_call import checked_call
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.rollout import rollout
from fpirhc.optimisers.base import Optimiser, judge
from fpirhc.optimisers.improved import improved
from fpirhc.optimisers.infeasible import reasons
from fpirhc.optimisers.multipliers import fit_multipliers
from fpirhc.optimisers.scales import tolerated
from fpirhc.status import Status
from fpirhc.summary import line, number, table

_WORST = 5  # violations in a text


@dataclass(frozen=True, eq=False)
class Plan:
    """A solved horizon.

    Args:
        inputs: U, shape (nu, N).
        states: X, shape (ns, N + 1).
        cost: V; None where the status is NON_FINITE, because what was tried has no such number.
        stationarity: as defined in `fpirhc.optimisers.base`; None like the cost.
        feasibility: as defined there; None like the cost.
        iterations: of the optimiser; -1: not known.
        calls: of the optimiser's step.
        status: of the plan.
        problem: the problem that was solved.
        data: its data, shape (ntheta, N + 1).
        bounds: lower and upper limits of the inputs, shape (nu,) each.
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
    bounds: tuple[np.ndarray, np.ndarray]

    def __repr__(self) -> str:
        return line(self, self.status.name, *(f"{name} {value}" for name, value in self._facts()))

    def _repr_html_(self) -> str:
        """The numbers of the plan and its faults as a table, for notebooks."""
        notes = [self.status.remedy, *self.violations(), *self.reasons(), self.overflow()]
        return table(f"Plan: {self.status.name}", ("", "value"), self._facts(), notes)

    def _facts(self) -> list[tuple[str, str]]:
        """The numbers that sum up the plan, by name."""
        steps = f"{self.iterations:g}" if self.iterations >= 0 else "unknown"
        return [
            ("cost", _shown(self.cost, lambda v: f"{v:.7g}")),
            ("stationarity", _shown(self.stationarity, number)),
            ("feasibility", _shown(self.feasibility, number)),
            ("stages", f"{self.problem.stages} of {self.problem.step:g} {self.problem.time_unit}"),
            ("iterations", f"{steps} in {self.calls} calls"),
        ]

    @cached_property
    def state_multipliers(self) -> np.ndarray:
        """Multipliers of the state bounds, shape (ns, N), fitted to the plan alone, without its optimiser."""
        return fit_multipliers(self.problem, self.inputs, self.states[:, 0], self.data, self.bounds)

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
                    side = f"below {low:g}" if value < low else f"above {high:g}"
                    violations.append((stage > 0, -by, f"'{name}' is {value:.6g} {unit}, {side}, at stage {stage}"))
        return tuple(text for _, _, text in sorted(violations)[:_WORST])

    def reasons(self) -> tuple[str, ...]:
        """Return for every limit that the plan violates what stops it, and whether softening would help."""
        return reasons(self.problem, self.states, self.inputs, self.bounds)

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
        """Return the cost of every soft limit and the price of every priced one over the horizon by name, zero where it is kept."""
        _, _, terms = rollout(self.problem)(self.states[:, 0], self.inputs, self.data)
        values = zip(self.problem.terms, np.asarray(terms.full()).ravel(), strict=True)
        prices = {name.removeprefix("soft "): float(v) for name, v in values if name.startswith("soft ")}
        ocp = self.problem
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
        start: first inputs, shape (nu, N); None: zero.

    Raises:
        NotSupported: the optimiser cannot serve the problem.
    """
    optimiser.check(ocp)
    layout = optimiser.memory(ocp)
    memory = layout.start()
    inputs = np.zeros((ocp.input.size, ocp.stages)) if start is None else np.asarray(start, dtype=float)
    memory[layout.slice("plan_inputs")] = inputs.ravel(order="F")
    inputs, diagnostics, _, count = improved(optimiser, ocp, state, data, memory, calls=calls)
    states = np.asarray(rollout(ocp)(state, inputs, data)[0].full())
    status = Status(int(diagnostics[4]))
    known = status != Status.NON_FINITE
    return Plan(
        inputs,
        states,
        float(diagnostics[0]) if known else None,
        float(diagnostics[1]) if known else None,
        float(diagnostics[2]) if known else None,
        float(diagnostics[3]) if diagnostics[3] >= 0 else -1.0,
        count,
        status,
        ocp,
        np.asarray(ca.DM(data).full()),
        (ocp.input_lower, ocp.input_upper),
    )


def _shown(value: float | None, text: Callable[[float], str]) -> str:
    return "none" if value is None else text(value)
