"""How one iteration and its code grow with the horizon and with the states, with and without limits of states, and what a whole
adaptive cycle costs.

    python benchmarks/growth.py [--write]          --write puts the tables into docs/performance.md

Compile times are wall times with an empty cache of compiled libraries, whose files are compiled side by side. Without limits of
states a row is one iteration; with limits it is a whole plan from nothing, because a call there ends where its plan is solved.
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
NOTHING = Evaluator(ca.Function("nothing", [ca.SX.sym("x")], [ca.SX(0)]))


def median(evaluator: Evaluator) -> float:
    """Microseconds of one evaluation, the median of many, less those of an evaluation of nothing: what a call from Python takes."""
    return (_median(evaluator) - _median(NOTHING)) / 1e3


def _median(evaluator: Evaluator) -> float:
    """Nanoseconds."""
    taken = np.empty(CALLS)
    for k in range(CALLS):
        begin = time.perf_counter_ns()
        evaluator.evaluate()
        taken[k] = time.perf_counter_ns() - begin
    return float(np.median(taken))


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


def limited(p: fp.Problem, size: float, *names: str) -> fp.Problem:
    """The problem with states that stay within a size."""
    return replace(p, limits=replace(p.limits, states=dict.fromkeys(names, (-size, size))))


def staged(p: fp.Problem, stages: int) -> fp.Problem:
    """The problem with so many stages."""
    assert p.horizon is not None
    return replace(p, horizon=replace(p.horizon, stages=stages))


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
    rows = [("two_mass, one iteration", *iteration(staged(two_mass, n))) for n in (10, 20, 50, 100, 200)]
    rows += [(f"chain of {n}, one iteration", *iteration(chain(n))) for n in (3, 5, 7)]
    slow = limited(two_mass, 8.0, "q1'", "q2'")
    rows += [("two_mass, limits of states, a plan", *iteration(staged(slow, n))) for n in (20, 200)]
    rows.append(("chain of 3, limits of states, a plan", *iteration(limited(chain(3), 0.1, "ye"))))
    rows.append(("two_mass, whole RHC+FPI cycle", *cycle()))
    heads = ("what", "stages", "states", "microseconds", "ns per stage", "kB of C", "s to compile")
    write_table("growth", heads, rows)


if __name__ == "__main__":
    main()
