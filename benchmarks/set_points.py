"""What set-points cost on two_mass, side by side in one run.

    python benchmarks/set_points.py

Process time of the compiled loop over 10 s of 1 kHz, alternating, best of several: along the sines of the shipped problem, and
towards set-points that change every second.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.simulation.loop import start_memory
from fpirhc.simulation.path import CHUNK
from fpirhc.simulation.simulate import Simulator, simulator
from fpirhc.simulation.step_arguments import set_point_table

sys.path.insert(0, str(Path(__file__).resolve().parent))

TASK = fp.load_problem("two_mass")
REPEATS = 15
STEPS = {
    "q1": [(float(k), 2.2 + 0.2 * (k % 2)) for k in range(10)],
    "q2": [(float(k), 5.4 + 0.2 * (k % 2)) for k in range(10)],
}
REFERENCES = {
    "sines": TASK.problem.reference,
    "set-points": fp.Setpoint(STEPS, rate=6.0),
    "announced": fp.Setpoint(STEPS, rate=6.0, announced=True),
}


def cycles(ready: Simulator) -> Callable[[], float]:
    """Process time of the loop alone, in s; filling in the set-points counts."""
    problem, log = ready.problem, np.empty((CHUNK, ready.loop.trace.size))
    start, rows = start_memory(ready.loop, problem, ready.controller), set_point_table(problem, None, problem.cycles)

    def work() -> float:
        evaluator = ready.evaluator
        evaluator.arguments[0][:] = start
        evaluator.redirect(1, log)
        begin = time.process_time()
        for k in range(problem.cycles // CHUNK):
            for argument in evaluator.arguments[1:-1]:
                argument.reshape(CHUNK, -1)[:] = rows[k * CHUNK : (k + 1) * CHUNK]
            evaluator.evaluate()
            evaluator.arguments[0][:] = evaluator.results[0]
        return time.process_time() - begin

    return work


def main() -> None:
    """Measure and print."""
    for name in ("CTC+FPI (eq 6)", "RHC+FPI"):
        problems = {label: replace(TASK.problem, reference=one) for label, one in REFERENCES.items()}
        works = {label: cycles(simulator(problem, TASK.controllers[name])) for label, problem in problems.items()}
        times = np.array([[work() for work in works.values()] for _ in range(REPEATS)])
        for k, label in enumerate(works):
            cycle, ratio = 1e6 * times[:, k].min() / TASK.problem.cycles, np.median(times[:, k] / times[:, 0])
            sys.stdout.write(f"{name:16s} {label:11s} {cycle:7.3f} us per cycle, {ratio:.3f} of the sines\n")


if __name__ == "__main__":
    main()
