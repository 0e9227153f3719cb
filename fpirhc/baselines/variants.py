"""Variants, under which a result counts as the same: seed, rounding, and the steps of the simulated plant.

`accept` measures every controller under all variants; the bands come from the spread of the results. C compiled at two levels
may agree to the last digit on this machine and not on another one. Rounding is therefore also tried directly: the first state and
the exact parameters change by the factor 1 + 1e-14.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.simulation.simulate import disturbance_table, sensing_table
from fpirhc.studies.scenarios.draws import with_exact
from fpirhc.symbolic.native import find_compiler
from fpirhc.task.problem import Problem

NOMINAL, SEEDS, ROUNDING, INTEGRATOR = "nominal", "seeds", "rounding", "integrator"
SOURCES = (SEEDS, ROUNDING, INTEGRATOR)
_NUDGE = 1e-14  # some tens of rounding errors


@dataclass(frozen=True)
class Variant:
    """One way to run a problem that leaves its settings alone.

    Args:
        source: source of spread to which it belongs.
        name: its name in words.
        seed: seed of the run.
        compiled: whether the run uses compiled C.
        flags: flags of the compiler.
        nudge: relative change of the first state and the exact parameters.
        finer: factor of the number of integrator steps.
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
        """Whether open-loop plans can differ in this variant: they are solved in the virtual machine, without noise."""
        return self.source == NOMINAL or self.nudge > 0

    def applied(self, problem: Problem) -> Problem:
        """Return the problem as it runs in this variant."""
        if self.nudge:
            start = {name: value * (1 + self.nudge) for name, value in problem.start.items()}
            elsewhere = replace(problem, start=start)
            return elsewhere if problem.foreign else with_exact(elsewhere, problem.real_plant.exact * (1 + self.nudge))
        if self.finer > 1:
            finer = problem.real_integrator.finer(self.finer) or problem.real_integrator
            if problem.symbolic_reality is not None:
                return replace(problem, reality=replace(problem.symbolic_reality, integrator=finer))
            return replace(problem, integrator=finer)
        return problem


def nominal(seed: int, compiled: bool) -> Variant:
    """Return the variant that `check` measures."""
    return Variant(NOMINAL, "nominal", seed, compiled)


def variants(problem: Problem, *, seed: int, seeds: int, compiled: bool) -> list[Variant]:
    """Return the nominal variant and all others that can differ from it; without noise there is one seed only."""
    all_variants = [nominal(seed, compiled)]
    if _is_random(problem):
        all_variants += [Variant(SEEDS, f"seed {seed + k}", seed + k, compiled) for k in range(1, seeds)]
    if compiled and find_compiler():
        all_variants.append(Variant(ROUNDING, "virtual machine", seed, False))
        all_variants.append(Variant(ROUNDING, "compiled -O0", seed, True, flags=("-O0",)))
    all_variants.append(
        Variant(ROUNDING, f"start and exact parameters moved by {_NUDGE:g}", seed, compiled, nudge=_NUDGE)
    )
    if not problem.foreign and problem.real_integrator.finer(2):
        all_variants.append(Variant(INTEGRATOR, "twice the integrator steps", seed, compiled, finer=2))
    return all_variants


def names_by_source(all_variants: Sequence[Variant]) -> dict[str, list[str]]:
    """Return the names of the variants by their source."""
    return {source: [v.name for v in all_variants if v.source == source] for source in SOURCES}


def _is_random(problem: Problem) -> bool:
    tables = (disturbance_table, sensing_table)
    return any(
        not np.array_equal(draw(problem, 0, problem.cycles), draw(problem, 1, problem.cycles)) for draw in tables
    )
