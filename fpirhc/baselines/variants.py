"""What a result may depend on without having changed: seed, rounding, and the steps of the simulated plant.

`accept` measures every controller under all of these; the spread of the results is what bands are made of. C compiled at
two levels may agree to the last digit, which says nothing about another machine, so rounding is also tried directly: the first
state and the exact parameters move by 1e-14 of themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.simulation.simulate import disturbance_table, sensing_table
from fpirhc.symbolic.native import find_compiler
from fpirhc.task.problem import Problem

NOMINAL, SEEDS, ROUNDING, INTEGRATOR = "nominal", "seeds", "rounding", "integrator"
SOURCES = (SEEDS, ROUNDING, INTEGRATOR)
_NUDGE = 1e-14  # some tens of rounding errors


@dataclass(frozen=True)
class Variant:
    """One way to run a problem that leaves its settings alone.

    source: which kind of spread it belongs to. name: in words. nudge: relative change of first state and exact parameters.
    finer: how many times more integrator steps.
    """

    source: str
    name: str
    seed: int
    compiled: bool
    flags: tuple[str, ...] = ()
    nudge: float = 0.0
    finer: int = 1

    @property
    def plans(self) -> bool:
        """Whether open-loop plans can differ here: they are solved in the virtual machine, without noise."""
        return self.source == NOMINAL or self.nudge > 0

    def applied(self, problem: Problem) -> Problem:
        """Return the problem as it runs in this variant."""
        if self.nudge:
            parameters = {
                name: replace(p, exact=p.exact * (1 + self.nudge)) for name, p in problem.plant.parameters.items()
            }
            start = {name: value * (1 + self.nudge) for name, value in problem.start.items()}
            return replace(problem, plant=replace(problem.plant, parameters=parameters), start=start)
        if self.finer > 1:
            return replace(problem, integrator=problem.integrator.finer(self.finer) or problem.integrator)
        return problem


def nominal(seed: int, compiled: bool) -> Variant:
    """The variant that `check` measures."""
    return Variant(NOMINAL, "nominal", seed, compiled)


def variants(problem: Problem, *, seed: int, seeds: int, compiled: bool) -> list[Variant]:
    """Return the nominal variant and all others that can differ from it; without noise there is one seed only."""
    found = [nominal(seed, compiled)]
    if _is_random(problem):
        found += [Variant(SEEDS, f"seed {seed + k}", seed + k, compiled) for k in range(1, seeds)]
    if compiled and find_compiler():
        found.append(Variant(ROUNDING, "virtual machine", seed, False))
        found.append(Variant(ROUNDING, "compiled -O0", seed, True, flags=("-O0",)))
    found.append(Variant(ROUNDING, f"start and exact parameters moved by {_NUDGE:g}", seed, compiled, nudge=_NUDGE))
    if problem.integrator.finer(2):
        found.append(Variant(INTEGRATOR, "twice the integrator steps", seed, compiled, finer=2))
    return found


def names_by_source(chosen: Sequence[Variant]) -> dict[str, list[str]]:
    """Return what was varied, in words."""
    return {source: [v.name for v in chosen if v.source == source] for source in SOURCES}


def _is_random(problem: Problem) -> bool:
    tables = (disturbance_table, sensing_table)
    return any(
        not np.array_equal(draw(problem, 0, problem.cycles), draw(problem, 1, problem.cycles)) for draw in tables
    )
