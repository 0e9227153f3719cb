"""What plans that end where they are solved cost beside one iteration: FixedPoint() against FixedPoint(iterations=1, ...).

    python benchmarks/default_plan.py            prints a table; --write puts it into docs/performance.md

Whole compiled loops of the headline pair, the two ways in turns in one process, least of the repetitions; the error is the largest
rms error of a coordinate over the whole run, and the tolerance of one iteration is that of the default.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.controllers.contract import with_optimiser
from fpirhc.simulation.loop import close_loop
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.native import native

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

PROBLEMS = ("two_mass", "van_der_pol", "two_link_arm", "delayed_mass", "delayed_tanks", "noisy_motor", "cart_pole")
REPEATS, CHUNK, CHUNKS = 12, 100, 4
WAYS = {"one": fp.FixedPoint(iterations=1), "solved": fp.FixedPoint()}


def timed(problem: fp.Problem, controller: fp.Controller) -> Callable[[], float]:
    """Function that returns the seconds of a cycle, over the first cycles of a run."""
    loop = close_loop(problem, controller)
    evaluator, log = Evaluator(native(loop.function, calls=CHUNK).function), np.empty((CHUNK, loop.trace.size))

    def once() -> float:
        evaluator.arguments[0][:], evaluator.arguments[-1][:] = loop.memory.start(), CHUNK
        begin = time.process_time()
        for _ in range(CHUNKS):
            evaluator.redirect(1, log)
            evaluator.evaluate()
            evaluator.arguments[0][:] = evaluator.results[0]
        return (time.process_time() - begin) / (CHUNK * CHUNKS)

    return once


def row_of(name: str, row: str) -> tuple[str, ...]:
    """Time, error and status of the two ways."""
    task = fp.load_problem(name)
    clocks, errors, unsolved = {}, {}, {}
    for way, optimiser in WAYS.items():
        controller = with_optimiser(task.controllers[row], optimiser)
        run = fp.simulate(task.problem, controller, seed=0)
        errors[way] = max(fp.measure(task.problem, run).rms_error.values())
        unsolved[way] = float(np.mean(run["status"] != fp.Status.OK))
        clocks[way] = timed(task.problem, controller)
    turns = [{way: clock() for way, clock in clocks.items()} for _ in range(REPEATS)]
    seconds = {way: min(turn[way] for turn in turns) for way in clocks}
    shares = (f"{seconds['solved'] / seconds['one']:.2f}", f"{errors['solved'] / errors['one']:.4f}")
    return f"{name}, {row}", f"{1e6 * seconds['one']:.2f}", *shares, *(f"{100 * unsolved[way]:.1f}" for way in WAYS)


def main() -> None:
    """Measure the problems named on the command line, or those of the page."""
    names = [a for a in sys.argv[1:] if not a.startswith("--")] or PROBLEMS
    rows = []
    for name in names:
        for row in fp.load_problem(name).headline or ():
            rows.append(row_of(name, row))
            print(" | ".join(rows[-1]), flush=True)
    heads = "loop", "one iteration, us per cycle", "solved: time", "error", "not ok, one, %", "not ok, solved, %"
    write_table("default plan", heads, rows)


if __name__ == "__main__":
    main()
