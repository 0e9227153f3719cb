"""How long it takes to say that a horizon is infeasible: two_mass with limits of states that no inputs keep, from nothing.

    python benchmarks/infeasible.py [--write]      --write puts the table into docs/performance.md

Milliseconds of one call, the smallest of ten; iterations, the status, and the violation of the plan that comes back.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from table import write_table

import fpirhc as fp
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.symbolic.native import native

CASES: tuple[dict[str, tuple[float, float]], ...] = (
    {"q1": (1.85, 2.35)},
    {"q1": (2.25, 2.35)},
    {"q1": (2.3, 2.35)},
    {"q1": (3.0, 3.2)},
    {"q1": (2.199, 2.201), "q2": (5.0, 5.3)},
)


def row(states: dict[str, tuple[float, float]], *, converging: bool) -> tuple[str, ...]:
    """One line: a call of a loop, or one that goes on until the plan is solved."""
    task = fp.load_problem("two_mass").problem
    p = replace(task, limits=replace(task.limits, states=states))
    ocp = transcribe(p.plant, p.reference, p.horizon, p.cost, p.limits)
    data = stage_data(p.plant, p.reference, p.horizon, p.cost)(0.0, p.plant.approximate).full()
    optimiser = fp.FixedPoint(iterations=1, tolerance=1e-3)
    step = native(optimiser.converging(ocp) if converging else optimiser.step(ocp), required=True).function
    first = ocp.start(p.start_state, np.zeros(ocp.input.size)).full().ravel()
    memory, taken = optimiser.memory(ocp).start(), []
    for _ in range(10):
        begin = time.perf_counter()
        found = step(first, data, ocp.input_lower, ocp.input_upper, memory)[1].full().ravel()
        taken.append(1e3 * (time.perf_counter() - begin))
    limits = ", ".join(f"{name} in {low:g} to {high:g}" for name, (low, high) in states.items())
    call = "until solved" if converging else "in a loop"
    return limits, call, f"{min(taken):.2f}", f"{found[3]:.0f}", fp.Status(int(found[4])).name, f"{found[2]:.2g}"


def main() -> None:
    """Measure and print."""
    rows = [row(states, converging=way) for states in CASES for way in (False, True)]
    write_table("infeasible", ("limits", "call", "ms", "iterations", "status", "violation"), rows)


if __name__ == "__main__":
    main()
