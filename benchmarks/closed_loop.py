"""Speed of the closed loop: every way of running the same 10 s of two_mass at 1 kHz, side by side in one run.

    python benchmarks/closed_loop.py            prints a table; --write puts it into docs/performance.md

Each way computes the same controller (CTC with eq (6)) and logs every signal, except the pure-Python loop, which computes
the same mathematics with floats and logs the states only, and so is favoured. Best of several repetitions.
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import by_hand
import numpy as np
from table import write_table

import fpirhc as fp

REPEATS = 40
TASK, CONTROLLER = by_hand.TASK, by_hand.CONTROLLER
CYCLES = TASK.problem.cycles


def best(work: Callable[[], object], repeats: int = REPEATS, clock: Callable[[], float] = time.process_time) -> float:
    """CPU seconds of the fastest repetition; the first, which compiles and warms up, does not count."""
    work()
    taken = []
    for _ in range(repeats):
        begin = clock()
        work()
        taken.append(clock() - begin)
    return min(taken)


def simulated(compiled: bool) -> Callable[[], object]:
    """The accumulated loop as `simulate` runs it, without its set-up: chunks, log, finiteness check."""
    made = fp.simulator(TASK.problem, CONTROLLER, compiled=compiled)
    loop, evaluator = made.loop, made.evaluator
    chunk = evaluator.results[1].size // loop.trace.size
    log = np.empty((CYCLES, loop.trace.size))

    def work() -> None:
        evaluator.arguments[0][:], evaluator.arguments[-1][:] = loop.memory.start(), chunk
        for at in range(0, CYCLES, chunk):
            evaluator.redirect(1, log[at : at + chunk])
            evaluator.evaluate()
            assert np.isfinite(np.sum(log[at : at + chunk]))
            evaluator.arguments[0][:] = evaluator.results[0]

    return work


def plain_calls() -> None:
    """A Python loop around an ordinary Function call, as most tools do; a tenth of the cycles."""
    loop = fp.simulator(TASK.problem, CONTROLLER, compiled=False).loop
    memory = loop.memory.start()
    for _ in range(CYCLES // 10):
        memory, _trace = loop.function(memory)


def python_floats() -> list[tuple[float, float]]:
    """The same loop written by hand with floats and the math module."""
    cycle, memory, states = by_hand.cycle_of(by_hand.FLOATS), by_hand.START, []
    for k in range(CYCLES):
        memory, _ = cycle(k * by_hand.PERIOD, memory, by_hand.EXACT)
        states.append(memory[:2])
    return states


def stepped(compiled: bool) -> Callable[[], object]:
    """The controller alone, stepped by hand through the public interface."""
    stepper = fp.Stepper(TASK.problem, CONTROLLER, compiled=compiled)
    state, realised = TASK.problem.start_state, np.zeros(2)

    def work() -> None:
        memory = stepper.start()
        for k in range(CYCLES):
            _, memory = stepper.step(k * 1e-3, state, realised, memory)

    return work


STARTS = {
    "`import casadi, numpy`": "import casadi, numpy",
    "`import fpirhc`": "import fpirhc",
    "`fpirhc list`": "from fpirhc.__main__ import main; main(['list'])",
    "`fpirhc --help`": "from fpirhc.__main__ import main; main(['--help'])",
}


def begun(code: str) -> float:
    """User time of a new process that runs this, s: the median of ten."""
    times = []
    for _ in range(10):
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=True)
        times.append(resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before)
    return statistics.median(times)


def main() -> None:
    """Measure and print; the ratios are to the compiled loop of the same run."""
    agree = np.array(python_floats())
    run = fp.simulate(TASK.problem, CONTROLLER, seed=0)
    assert np.abs(agree[:-1] - run["state"][1:, :2]).max() < 1e-9, "the hand-written loop is another one"
    micro = {
        "closed loop, compiled C, every signal logged": best(simulated(True)) / CYCLES,
        "closed loop, CasADi virtual machine, every signal logged": best(simulated(False)) / CYCLES,
        "closed loop, pure Python floats, states logged": best(python_floats, 10) / CYCLES,
        "closed loop, Python loop of plain Function calls": best(plain_calls, 10) / (CYCLES // 10),
        "controller alone, stepped by hand, compiled C": best(stepped(True)) / CYCLES,
        "controller alone, stepped by hand, virtual machine": best(stepped(False)) / CYCLES,
    }
    base = micro["closed loop, compiled C, every signal logged"]
    rows = [(name, f"{1e6 * value:.2f}", f"{value / base:.1f}") for name, value in micro.items()]
    heads = "two_mass, CTC with eq (6), 10 s at 1 kHz", "microseconds per cycle", "times the compiled loop"
    write_table("closed loop", heads, rows)
    starts = {name: begun(code) for name, code in STARTS.items()}
    least = next(iter(starts.values()))
    rows = [(name, f"{value:.2f}", f"{value / least:.1f}") for name, value in starts.items()]
    write_table("start", ("start of a process", "s of user time", "times that of casadi and numpy"), rows)


if __name__ == "__main__":
    main()
