"""How one iteration and its code grow with the horizon and with the states, and what a whole adaptive cycle costs.

    python benchmarks/growth.py [--write]          --write puts the tables into docs/performance.md

Compile times are measured with an empty cache of compiled libraries.
"""

from __future__ import annotations

import os
import runpy
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ["FPIRHC_CACHE"] = tempfile.mkdtemp(prefix="fpirhc-growth-")

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.controllers.sensing_chain import compose_controller
from fpirhc.horizon.stage_data import stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.native import generate, native

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

CALLS = 2000
ITERATION = fp.FixedPoint(iterations=1, tolerance=1e-6)


def median(evaluator: Evaluator) -> float:
    """Microseconds of one evaluation, the median of many."""
    taken = np.empty(CALLS)
    for k in range(CALLS):
        begin = time.perf_counter_ns()
        evaluator.evaluate()
        taken[k] = time.perf_counter_ns() - begin
    return float(np.median(taken)) / 1e3


def compiled(function: ca.Function) -> tuple[Evaluator, float, float]:
    """The compiled Function, kilobytes of C, and the seconds that compiling took."""
    size = sum(map(len, generate(function))) / 1e3
    begin = time.perf_counter()
    library = native(function)
    assert library.compiled, library.reason
    return Evaluator(library.function), size, time.perf_counter() - begin


def iteration(p: fp.Problem) -> tuple[str, ...]:
    """One iteration with its final evaluation."""
    ocp = transcribe(p.plant, p.reference, p.horizon, p.cost, p.limits)
    data = stage_data(p.plant, p.reference, p.horizon, p.cost)(0.0, p.plant.approximate).full()
    evaluator, size, seconds = compiled(ITERATION.step(ocp))
    first = ocp.start(p.start_state, np.zeros(ocp.input.size)).full().ravel()
    evaluator(first, data.T, ocp.input_lower, ocp.input_upper, ITERATION.memory(ocp).start())
    micro = median(evaluator)
    per_stage = 1e3 * micro / p.horizon.stages
    return (
        f"{p.horizon.stages}",
        f"{ocp.state.size}",
        f"{micro:.3g}",
        f"{per_stage:.0f}",
        f"{size:.0f}",
        f"{seconds:.1f}",
    )


def cycle() -> tuple[str, ...]:
    """One adaptive RHC+FPI cycle, measurement to command, that plans anew with one iteration."""
    task = fp.load_problem("two_mass")
    p = replace(task.problem, period=task.problem.horizon.step)
    composite = compose_controller(p, task.controllers["RHC+FPI"])
    evaluator, size, seconds = compiled(composite.function)
    evaluator(composite.memory.start(), 0.0, p.start_state, np.zeros(2), p.plant.approximate)
    evaluator.arguments[0][...] = evaluator.results[0]
    micro = median(evaluator)
    return f"{p.horizon.stages}", "4", f"{micro:.3g}", f"{1e3 * micro / 20:.0f}", f"{size:.0f}", f"{seconds:.1f}"


def main() -> None:
    """Measure and print."""
    two_mass = fp.load_problem("two_mass").problem
    chain = runpy.run_path(str(fp.load_problem("chain_of_masses").path))["chain"]
    rows = [
        ("two_mass, one iteration", *iteration(replace(two_mass, horizon=replace(two_mass.horizon, stages=n))))
        for n in (10, 20, 50, 100, 200)
    ]
    rows += [(f"chain of {n}, one iteration", *iteration(chain(n))) for n in (3, 5, 7)]
    rows.append(("two_mass, whole RHC+FPI cycle", *cycle()))
    heads = ("what", "stages", "states", "microseconds", "ns per stage", "kB of C", "s to compile")
    write_table("growth", heads, rows)


if __name__ == "__main__":
    main()
