"""Speed of the closed loop: every way of running the same 10 s of two_mass at 1 kHz, side by side in one run.

    python benchmarks/closed_loop.py            prints a table; --write puts it into docs/performance.md

Each way computes the same controller (CTC with eq (6)) and logs every signal, except the pure-Python loop, which computes
the same mathematics with floats and logs the states only, and so is favoured. Best of several repetitions.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import by_hand
import numpy as np
from table import write_table

import fpirhc as fp

TASK, CONTROLLER = by_hand.TASK, by_hand.CONTROLLER
CYCLES = TASK.problem.cycles


def best(work: Callable[[], object], repeats: int = 40) -> float:
    """CPU seconds of the fastest repetition; the first, which compiles and warms up, does not count."""
    work()
    taken = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        taken.append(time.process_time() - begin)
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


COMMANDS = """compare two_mass -c RHC RHC+FPI
review two_mass -c RHC RHC+FPI
study two_mass -c RHC RHC+FPI --draws 50 --mismatch 20
tune two_mass -c RHC+FPI --trials 50
probe two_mass -c RHC+FPI"""


def taken(command: str, cache: str) -> str:
    """CPU time of a command in an empty folder, with all processes that it starts, compilers too, s."""
    words, own = [sys.executable, "-m", "fpirhc", *command.split()], {**os.environ, "FPIRHC_CACHE": cache}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(words, cwd=tempfile.mkdtemp(), env=own, stdout=subprocess.DEVNULL, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return f"{after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime:.2g}"


def commands() -> None:
    """The table of commands: each with an empty cache, and once more with what is compiled."""
    caches = {command: tempfile.mkdtemp() for command in COMMANDS.splitlines()}
    rows = [(f"`fpirhc {command}`", taken(command, at), taken(command, at)) for command, at in caches.items()]
    write_table("commands", ("command", "s of CPU time, nothing compiled", "again"), rows)


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
    rows = [(name, f"{1e6 * value:.2f}", f"{value / min(micro.values()):.1f}") for name, value in micro.items()]
    write_table("closed loop", ("two_mass, CTC with eq (6), 10 s at 1 kHz", "us per cycle", "times the compiled"), rows)
    commands()


if __name__ == "__main__":
    main()
