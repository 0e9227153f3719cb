"""How a run kept its hard limits: of states, of rates, and of expressions."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.horizon.cost import View
from fpirhc.simulation.run import Run
from fpirhc.symbolic.layout import Named, Signal
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Followed:
    """One hard limit along a run."""

    name: str
    unit: str
    lower: float
    upper: float
    values: np.ndarray  # of the limited quantity in every cycle

    @property
    def beyond(self) -> np.ndarray:
        """How far every cycle is beyond it, as a share of its range; of the limit's own size where one side is free."""
        span, size = self.upper - self.lower, abs(self.upper if np.isfinite(self.upper) else self.lower)
        room = span if np.isfinite(span) else max(size, 1e-3 * float(np.abs(self.values).max(initial=0.0)), 1e-300)
        return np.maximum(np.maximum(self.values - self.upper, self.lower - self.values), 0.0) / room


def hard_limits(problem: Problem, run: Run) -> list[Followed]:
    """Return the limits of states, rates and paths that are neither soft nor priced, along a run; none without cycles.

    A change of the command counts from cycle to cycle. What limits say about a reality with other states is not known.
    """
    plant, weighed = problem.plant, {*problem.limits.soft, *problem.limits.prices}
    limits = {**problem.limits.boxes(plant), **problem.limits.written(plant, problem.period)}
    rates = {f"{name} rate": name for name in problem.limits.rates if name not in plant.state.elements}
    hard = {name: one for name, one in limits.items() if not {name, rates.get(name, name)} & weighed}
    if not hard or not run.cycles or run["plant_state"].shape[1] != plant.state.size:
        return []
    x, u, p = (ca.SX.sym(one.name, one.size) for one in (plant.state, plant.input, plant.parameter))
    before, t, calm = ca.SX.sym("before", plant.input.size), ca.SX.sym("t"), ca.SX.zeros(len(plant.names))
    view = View(
        state=_named(plant.state, x),
        reference=_named(plant.output, ca.SX.nan(plant.output.size)),
        input=_named(plant.input, u),
        input_before=_named(plant.input, before),
        feedforward=_named(plant.input, ca.SX.nan(plant.input.size)),
        parameters=_named(plant.parameter, p),
        time=t,
        output=_named(plant.output, plant.equations.output(x, u, p, calm)),
        outside=Named((), ca.SX(0, 1), "outside"),
    )
    column = ca.vertcat(*(one.named_value(name, view) for name, one in hard.items()))
    sent = run["command"].reshape(run.cycles, -1)
    past = np.vstack([problem.inputs_before, sent[:-1]])
    given = run["plant_state"], sent, past, np.tile(plant.approximate, (run.cycles, 1)), run["time"].reshape(-1, 1)
    along = ca.Function("fpirhc_limited", [x, u, before, p, t], [column]).map(run.cycles)(*(g.T for g in given)).full()
    pairs = zip(hard.items(), along, strict=True)
    return [Followed(name, one.unit, one.lower, one.upper, values) for (name, one), values in pairs]


def _named(signal: Signal, value: ca.SX) -> Named:
    return Named(signal.elements, value, signal.name)
