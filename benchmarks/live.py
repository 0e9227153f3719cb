"""What live settings cost and save on two_mass, side by side in one run.

    python benchmarks/live.py            prints a table; --write puts it into docs/performance.md

Costs: process time of the compiled loop over 10 s of 1 kHz, with and without live settings, in turns that change places. The
difference is the median of the quotients of pairs that ran one after the other, with their quartiles; times are the best.
Savings: a study of other settings with one live loop, and with a loop built for each (virtual machine, as a search without live
settings does).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.problem_files.settings import with_settings
from fpirhc.simulation.loop import start_memory
from fpirhc.simulation.simulate import CHUNK, Simulator, simulator

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

TASK = fp.load_problem("two_mass")
REPEATS = 101
STUDY = 10  # settings of a study
COSTS = (
    ("CTC+FPI (eq 6)", ()),
    ("CTC+FPI (eq 6)", ("tracking.rate", "deformation.gain", "deformation.scale")),
    ("CTC+FPI (eq 6)", ("tracking.rate", "deformation.gain", "deformation.scale", "limits.inputs")),
    ("CTC+FPI (eq 6)", ("deformation.gain", "limits.inputs")),
    ("RHC+FPI", ("deformation.gain",)),
    ("RHC+FPI", ("deformation.gain", "cost.states.q1", "cost.states.q2'", "cost.deviation.Q1", "limits.inputs.Q1.1")),
)
STUDIES = (
    ("CTC+FPI (eq 6)", lambda k: {"tracking.rate": 4 + 0.5 * k, "deformation.gain": -0.3 - 0.05 * k}),
    ("RHC+FPI", lambda k: {"deformation.gain": -0.3 - 0.05 * k, "deformation.scale": 20.0 + k}),
)


def paths(names: Sequence[str]) -> list[str]:
    """Paths of settings; 'limits.inputs' stands for both inputs, so that there are five numbers or more."""
    return [p for n in names for p in ([f"{n}.Q1", f"{n}.Q2"] if n == "limits.inputs" else [n])]


def cycles(ready: Simulator) -> Callable[[], float]:
    """Process time of the loop alone."""
    log = np.empty((CHUNK, ready.loop.trace.size))
    start = start_memory(ready.loop, ready.problem, ready.controller, ready.live.start)

    def work() -> float:
        evaluator = ready.evaluator
        evaluator.arguments[0][:] = start
        evaluator.redirect(1, log)
        begin = time.process_time()
        for _ in range(ready.problem.cycles // CHUNK):
            evaluator.evaluate()
            evaluator.arguments[0][:] = evaluator.results[0].reshape(CHUNK, -1)[-1]
        return time.process_time() - begin

    return work


def cost(name: str, live: Sequence[str]) -> list[str]:
    """Row: microseconds of a cycle without and with live settings, and the ratio."""
    works = [cycles(simulator(TASK.problem, TASK.controllers[name], live=p)) for p in ((), live)]
    orders = [(0, 1) if k % 2 else (1, 0) for k in range(REPEATS)]
    times = np.array([[t for _, t in sorted((k, works[k]()) for k in order)] for order in orders])
    plain, lively = 1e6 * times.min(axis=0) / TASK.problem.cycles
    low, middle, high = 100 * (np.quantile(times[:, 1] / times[:, 0], (0.25, 0.5, 0.75)) - 1)
    difference = f"{middle:+.1f} % ({low:+.1f} to {high:+.1f})"
    return [f"{name}, {len(live)} live", f"{plain:.3f} us", f"{lively:.3f} us", difference]


def study(name: str, numbers: Callable[[int], dict[str, float]]) -> list[str]:
    """Row: milliseconds of one setting by building anew and with one live loop, and their ratio."""
    controller = TASK.controllers[name]
    begin = time.process_time()
    for k in range(STUDY):
        simulator(TASK.problem, with_settings(controller, numbers(k)), compiled=False).run(seed=0)
    middle = time.process_time()
    ready = simulator(TASK.problem, controller, live=list(numbers(0)))
    ready.run(seed=0, settings=numbers(0))
    built = time.process_time()
    for k in range(STUDY):
        ready.run(seed=0, settings=numbers(k))
    end = time.process_time()
    anew, live = (1e3 * t / STUDY for t in (middle - begin, end - built))
    return [f"{name}, one of {STUDY} settings", f"{anew:.1f} ms", f"{live:.1f} ms", f"1/{anew / live:.1f}"]


def main() -> None:
    """Measure and print."""
    rows = [cost(name, paths(live)) for name, live in COSTS] + [study(*one) for one in STUDIES]
    write_table("live", ("", "numbers in the code", "live", "difference"), rows)


if __name__ == "__main__":
    main()
