"""Microseconds per cycle and plant of a closed loop: plants side by side in vector registers beside the ordinary compiled loop.

    python benchmarks/lanes.py [--write] [--million]      --write puts the table into docs/performance.md
                                                          --million runs a million plants for 500 cycles (a minute)

Processor time of both in one process, in turn, the smallest of five; the ordinary runs keep their log and are measured by the same
errors.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np
from table import write_table

import fpirhc as fp
from fpirhc.simulation.lanes import run_many
from fpirhc.simulation.metrics.base import measured_errors
from fpirhc.simulation.simulate import Simulator

LOOPS = {"two_mass": ("CTC", "CTC+FPI (eq 6)", "CTC+FPI (eq 3)"), "mrac_pendulum": ("CTC+FPI",), "puma560": ("CT+FPI",)}
PLANTS, ALONE, MANY = 512, 8, 1_000_000


def plants(ready: Simulator, count: int) -> np.ndarray:
    """Parameters within 10 % of the exact ones."""
    exact = ready.problem.plant.exact
    return exact * (1 + 0.1 * np.random.default_rng(0).uniform(-1, 1, (count, exact.size)))


def alone(ready: Simulator, exact: np.ndarray) -> np.ndarray:
    """Rms errors of plants that run one after the other."""
    variants = [ready.problem.with_exact(one) for one in exact]
    return np.array([np.sqrt(np.mean(measured_errors(v, ready.run(seed=0, variant=v)) ** 2, axis=0)) for v in variants])


def row(name: str, controller: str) -> list[str]:
    """Both times, their ratio and the largest relative difference of an rms error."""
    task = fp.load_problem(name)
    ready = fp.simulator(task.problem, task.controllers[controller])
    exact = plants(ready, PLANTS)
    many, single = run_many(ready, exact), alone(ready, exact[:ALONE])
    apart = max(np.abs(many.rms_error[n][:ALONE] / single[:, k] - 1).max() for k, n in enumerate(many.rms_error))
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(5):
        for spent, work, count in ((times[0], run_many, PLANTS), (times[1], alone, ALONE)):
            begun = time.process_time()
            work(ready, exact[:count])
            spent.append(1e6 * (time.process_time() - begun) / count / task.problem.cycles)
    lanes, ordinary = (min(spent) for spent in times)
    return [
        f"{name}, {controller}",
        str(many.lanes),
        f"{lanes:.3f}",
        f"{ordinary:.3f}",
        f"{ordinary / lanes:.1f}",
        f"{apart:.1g}",
    ]


def million() -> str:
    """Wall and processor time of a million plants of 500 cycles."""
    task = fp.load_problem("two_mass")
    ready = fp.simulator(replace(task.problem, duration=0.5, measure_from=0.1), task.controllers["CTC+FPI (eq 6)"])
    exact, begun = plants(ready, MANY // 10), (time.time(), time.process_time())
    for _ in range(10):
        run_many(ready, exact)
    return f"{MANY} plants x 500 cycles: {time.time() - begun[0]:.1f} s, {time.process_time() - begun[1]:.1f} s of processor time"


def main() -> None:
    """Measure and print, and write the table where it is asked for."""
    head = ["loop", "lanes", "us in lanes", "us alone", "ratio", "apart"]
    rows = [row(name, one) for name, some in LOOPS.items() for one in some]
    write_table("lanes", head, rows)
    if "--million" in sys.argv:
        print(million())


if __name__ == "__main__":
    main()
