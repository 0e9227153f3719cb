"""What live settings cost and save on two_mass, side by side in one run.

    python benchmarks/live.py            prints a table; --write puts it into docs/performance.md

Costs: process time of the compiled loop over 10 s of 1 kHz, with and without live settings, alternating, best of several.
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
REPEATS = 15
STUDY = 10  # settings of a study
COSTS = (
    ("CTC+FPI (eq 6)", ("tracking.rate", "deformation.gain", "deformation.scale")),
    ("CTC+FPI (eq 6)", ("tracking.rate", "deformation.gain", "deformation.scale", "limits.inputs")),
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
    times = np.array([[work() for work in works] for _ in range(REPEATS)])
    plain, lively = 1e6 * times.min(axis=0) / TASK.problem.cycles
    ratio = np.median(times[:, 1] / times[:, 0])
    return [f"{name}, {len(live)} live", f"{plain:.3f} us", f"{lively:.3f} us", f"{100 * (ratio - 1):+.1f} %"]


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
