"""How a run kept its hard limits: of states, of rates, and of expressions."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.horizon.cost import view_of
from fpirhc.plant.motion import with_space
from fpirhc.simulation.run import Run
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

TOLERANCE = 1e-3  # of its range: a run that is further beyond has left a limit


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
        """How far every cycle is beyond it, as a share of its range; of one side's own size, and beside 0 of the value's."""
        span, size = self.upper - self.lower, abs(self.upper if np.isfinite(self.upper) else self.lower)
        largest = float(np.abs(self.values).max(initial=1e-300))
        room = span if np.isfinite(span) else size if size > 1e-3 * largest else largest
        return np.maximum(np.maximum(self.values - self.upper, self.lower - self.values), 0.0) / room

    @property
    def sentence(self) -> str:
        """How far it is left, and how often."""
        unit, worst = with_space(self.unit), float(self.values[self.beyond.argmax()])
        limit = self.upper if worst > self.upper else self.lower
        share = in_percent(float((self.beyond > TOLERANCE).mean()))
        return (
            f"{self.name} reaches {worst:.4g}{unit}, beyond its hard limit of {limit:g}{unit}, in {share} of the cycles"
        )


def hard_limits(problem: Problem, run: Run) -> list[Followed]:
    """Return the limits of states, rates and paths that have no price, along a run; none without cycles.

    A change of the command counts from cycle to cycle. Limits of states that a reality does not have are not known.
    """
    plant, weighed = problem.plant, problem.limits.prices.keys()
    limits = {**problem.limits.boxes(plant), **problem.limits.written(plant, problem.period)}
    rates = {f"{name} rate": name for name in problem.limits.rates if name not in plant.state.elements}
    hard = {name: one for name, one in limits.items() if not {name, rates.get(name, name)} & weighed}
    if not hard or not run.cycles:
        return []
    shown = run.layout["plant_state"].elements if "plant_state" in run.layout else ()
    unknown = np.full(run.cycles, np.nan)
    states = np.column_stack([run[f"plant_state.{n}"] if n in shown else unknown for n in plant.state.elements])
    x, u, p = (ca.SX.sym(one.name, one.size) for one in (plant.state, plant.input, plant.parameter))
    before, t = ca.SX.sym("before", plant.input.size), ca.SX.sym("t")
    view = view_of(plant, x, u, p, t, before=before)
    column = ca.vertcat(*(one.named_value(name, view) for name, one in hard.items()))
    sent = run["command"].reshape(run.cycles, -1)
    past = np.vstack([problem.inputs_before, sent[:-1]])
    given = states, sent, past, np.tile(plant.approximate, (run.cycles, 1)), run["time"].reshape(-1, 1)
    along = ca.Function("fpirhc_limited", [x, u, before, p, t], [column]).map(run.cycles)(*(g.T for g in given)).full()
    pairs = zip(hard.items(), along, strict=True)
    return [Followed(n, one.unit, one.lower, one.upper, v) for (n, one), v in pairs if not np.isnan(v).all()]


def limits_left(problem: Problem, run: Run) -> tuple[Followed, ...]:
    """Return the hard limits that a run has left by more than the tolerance, the worst first; arguments as in `hard_limits`."""
    worst = {one: float(one.beyond.max()) for one in hard_limits(problem, run)}
    return tuple(sorted((one for one in worst if worst[one] > TOLERANCE), key=lambda one: -worst[one]))
