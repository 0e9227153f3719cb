"""What each block of the adaptive loop costs: the same closed loop with and without it, side by side in one run.

    python benchmarks/blocks.py            prints a table; --write puts it into docs/performance.md

two_mass at 1 kHz under computed torque with eq (6), compiled, every signal logged; the difference to the plain loop is the
block's. The rounds of all loops alternate, so that a busy machine is busy for all of them; each loop's fastest round counts.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.simulation.loop import close_loop
from fpirhc.simulation.tables import run_tables
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.native import native
from fpirhc.task.problem import Problem

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

ROUNDS, CHUNK = 60, 500
PROBLEM = fp.load_problem("two_mass").problem
LAW = fp.Exponential(rate=6.0)
MAP = fp.Sigmoid(gain=-0.5, shift=0.3, scale=1.0)
LATE = replace(PROBLEM, dead_time=fp.DeadTime(inputs={"Q1": 3e-3, "Q2": 4.5e-3}, measurement=5e-4))
EQUALLY_LATE = replace(PROBLEM, dead_time=fp.DeadTime(inputs={"Q1": 3e-3, "Q2": 3e-3}))
SEEN = replace(
    PROBLEM,
    sensing=fp.Sensing(
        {q: fp.Sensor(noise=fp.Noise(1e-6), quantum=1e-6, dropout=0.01) for q in ("q1", "q2")},
        fp.SavitzkyGolay(window=5, degree=2),
    ),
)
EVERYTHING = replace(SEEN, dead_time=EQUALLY_LATE.dead_time)
SHORT = fp.Fractional(rate=6.0, order=0.9, memory=0.2)
LONG = fp.Fractional(rate=6.0, order=0.9)
GUARD = 1e4  # m/s^2


def computed_torque(deformation: object, law: object = LAW) -> Controller:
    """The controller of every row."""
    return fp.ComputedTorque(law, deformation)


ALL = fp.Guarded(
    fp.Damped(fp.Tuned(fp.Increment(fp.Filtered(MAP, pole=0.5), cycles=4.5), largest_gain=0.3)),
    largest_deformation=GUARD,
)
LOOPS: dict[str, tuple[Problem, Controller]] = {
    "plain loop": (PROBLEM, computed_torque(MAP)),
    "dead time of inputs and measurement (4 cycles)": (LATE, computed_torque(MAP)),
    "`Increment` (4 cycles)": (PROBLEM, computed_torque(fp.Increment(MAP, cycles=4))),
    "`ModelReferenced`": (PROBLEM, computed_torque(fp.ModelReferenced(MAP))),
    "`ModelReferenced` (4 cycles)": (PROBLEM, computed_torque(fp.ModelReferenced(MAP, cycles=4))),
    "`ModelReferenced` through a lag": (PROBLEM, computed_torque(fp.ModelReferenced(MAP, lag=1e-2))),
    "`SelfPaired` (at most 10 cycles)": (PROBLEM, computed_torque(fp.SelfPaired(MAP, most=10))),
    "`Predicted` by the model (3 cycles)": (EQUALLY_LATE, fp.Predicted(computed_torque(MAP), inputs=3e-3)),
    "`Predicted` by desired (3 cycles)": (
        EQUALLY_LATE,
        fp.Predicted(computed_torque(MAP), inputs=3e-3, by=fp.ByDesired()),
    ),
    "sensors and `SavitzkyGolay`": (SEEN, computed_torque(fp.Affine(gain=-0.1))),
    "the same, `ModelReferenced` with its twin": (SEEN, computed_torque(fp.ModelReferenced(fp.Affine(gain=-0.1)))),
    "`Filtered`": (PROBLEM, computed_torque(fp.Filtered(MAP, pole=0.5))),
    "`Tuned`": (PROBLEM, computed_torque(fp.Tuned(MAP, largest_gain=0.5))),
    "`Damped`": (PROBLEM, computed_torque(fp.Damped(MAP))),
    "`Guarded`": (PROBLEM, computed_torque(fp.Guarded(MAP, largest_deformation=GUARD))),
    "`Fractional`, memory of 200 cycles": (PROBLEM, computed_torque(MAP, SHORT)),
    "`Fractional`, memory of 3334 cycles": (PROBLEM, computed_torque(MAP, LONG)),
    "together: dead time, sensors, `Guarded(Damped(Tuned(Increment(Filtered))))`": (EVERYTHING, computed_torque(ALL)),
    "the same with `Fractional`, memory of 200 cycles": (EVERYTHING, computed_torque(ALL, SHORT)),
}


def accumulated(problem: Problem, controller: Controller) -> Callable[[], float]:
    """Return a call that runs 500 cycles and says how many seconds they took."""
    loop = close_loop(problem, controller)
    backend = native(loop.function, calls=CHUNK)
    if not backend.compiled:
        sys.exit("this benchmark needs a C compiler")
    evaluator = Evaluator(backend.function)
    for argument, table in zip(evaluator.arguments[1:-1], run_tables(problem, 0, CHUNK), strict=True):
        argument.reshape(CHUNK, -1)[:] = table
    start = loop.memory.start()

    def work() -> float:
        evaluator.arguments[0][:] = start
        begin = time.perf_counter()
        evaluator.evaluate()
        return time.perf_counter() - begin

    work()
    return work


def main() -> None:
    """Measure and print; the differences are to the plain loop of the same run."""
    works = {name: accumulated(*loop) for name, loop in LOOPS.items()}
    taken = {name: np.array([0.0] * ROUNDS) for name in works}
    for k in range(ROUNDS):
        for name, work in works.items():
            taken[name][k] = work()
    micro = {name: 1e6 * times.min() / CHUNK for name, times in taken.items()}
    base = micro["plain loop"]
    rows = [
        (name, f"{value:.2f}", "" if name == "plain loop" else f"{value - base:+.2f}", f"{value / base:.2f}")
        for name, value in micro.items()
    ]
    heads = ("two_mass, CTC with eq (6), compiled", "microseconds per cycle", "more than plain", "times the plain loop")
    write_table("blocks", heads, rows)


if __name__ == "__main__":
    main()
