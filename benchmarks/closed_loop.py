"""Speed of the closed loop: every way of running the same 10 s of two_mass at 1 kHz, side by side in one run.

    python benchmarks/closed_loop.py            prints a table; --write puts it into docs/performance.md

Each way computes the same controller (CTC with eq (6)) and logs every signal, except the pure-Python loop, which computes
the same mathematics with floats and logs the states only, and so is favoured. Best of several repetitions.
"""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.simulation.loop import close_loop
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.native import native
from fpirhc.symbolic.program import chained

sys.path.insert(0, str(Path(__file__).resolve().parent))
from table import write_table

REPEATS = 7
TASK = fp.load_problem("two_mass")
CONTROLLER = TASK.controllers["CTC+FPI (eq 6)"]
CYCLES = TASK.problem.cycles


def best(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Seconds of the fastest repetition; the first, which compiles and warms up, does not count."""
    work()
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def simulated(compiled: bool) -> Callable[[], object]:
    """The accumulated loop as `simulate` runs it, without its set-up: chunks, log, finiteness check."""
    loop = close_loop(TASK.problem, CONTROLLER)
    chunk = 500
    function = native(loop.function, calls=chunk).function if compiled else chained(loop.function, chunk, 5)
    evaluator = Evaluator(function)
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
    loop = close_loop(TASK.problem, CONTROLLER)
    memory = loop.memory.start()
    for _ in range(CYCLES // 10):
        memory, _trace = loop.function(memory)


def python_floats() -> list[tuple[float, float]]:
    """The same loop written by hand with floats and the math module."""
    p, h = 1e-3, 0.3
    exact, model = (
        [q.exact for q in TASK.problem.plant.parameters.values()],
        [q.approximate for q in TASK.problem.plant.parameters.values()],
    )

    def response(x, v, u, par):
        m1, m2, s1, s2, k1, k2, l1, l2, b1, b2, g = par
        d1, d2 = x[0] - l1, x[1] - x[0] - l2
        f1 = k1 * d1 * (d1 * d1 + 1e-12) ** ((s1 - 1) / 2)
        f2 = k2 * d2 * (d2 * d2 + 1e-12) ** ((s2 - 1) / 2)
        return g + (-f1 + f2 - b1 * v[0] + u[0]) / m1, g + (-f2 - b2 * v[1] + u[1]) / m2

    t_ = math.tanh(h)
    y = (-1 + math.sqrt(1 + 8 * t_ * t_)) / (4 * t_)
    fixed = math.atanh(y)
    x, v, r, f, e_int, states = [2.2, 5.4], [0.0, 0.0], None, None, None, []
    for k in range(CYCLES):
        t = k * p
        ref = (2.2 + 0.3 * math.sin(2 * t), 5.4 + 0.3 * math.sin(3 * t))
        dref = (0.6 * math.cos(2 * t), 0.9 * math.cos(3 * t))
        ddref = (-1.2 * math.sin(2 * t), -2.7 * math.sin(3 * t))
        e, de = [ref[i] - x[i] for i in (0, 1)], [dref[i] - v[i] for i in (0, 1)]
        if e_int is None:
            e_int = [-(108 * e[i] + 18 * de[i]) / 216 for i in (0, 1)]
        want = [ddref[i] + 216 * e_int[i] + 108 * e[i] + 18 * de[i] for i in (0, 1)]
        if r is None:
            r = want
        else:
            err = [f[i] - want[i] for i in (0, 1)]
            size = math.sqrt(err[0] ** 2 + err[1] ** 2 + 1e-18)
            grow = (math.atanh(0.5 * math.tanh(-0.5 * size + fixed + h)) - fixed) / size
            r = [r[i] + grow * err[i] for i in (0, 1)]
        free = response(x, v, (0.0, 0.0), model)
        u = ((r[0] - free[0]) * model[0], (r[1] - free[1]) * model[1])
        u = tuple(min(300.0, max(-300.0, value)) for value in u)
        e_int = [e_int[i] + p * e[i] for i in (0, 1)]
        a1 = response(x, v, u, exact)
        x2, v2 = [x[i] + p / 2 * v[i] for i in (0, 1)], [v[i] + p / 2 * a1[i] for i in (0, 1)]
        a2 = response(x2, v2, u, exact)
        x3, v3 = [x[i] + p / 2 * v2[i] for i in (0, 1)], [v[i] + p / 2 * a2[i] for i in (0, 1)]
        a3 = response(x3, v3, u, exact)
        x4, v4 = [x[i] + p * v3[i] for i in (0, 1)], [v[i] + p * a3[i] for i in (0, 1)]
        a4 = response(x4, v4, u, exact)
        x = [x[i] + p / 6 * (v[i] + 2 * v2[i] + 2 * v3[i] + v4[i]) for i in (0, 1)]
        v = [v[i] + p / 6 * (a1[i] + 2 * a2[i] + 2 * a3[i] + a4[i]) for i in (0, 1)]
        f = response(x, v, u, exact)
        states.append((x[0], x[1]))
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


def help_time() -> float:
    """Seconds until `fpirhc --help` has answered."""
    command = [sys.executable, "-m", "fpirhc", "--help"]
    return best(lambda: subprocess.run(command, check=True, capture_output=True), 5)


def main() -> None:
    """Measure and print; the ratios are to the compiled loop of the same run."""
    agree = np.array(python_floats())
    run = fp.simulate(TASK.problem, CONTROLLER, seed=0)
    assert np.abs(agree[:-1] - run["state"][1:, :2]).max() < 1e-9, "the hand-written loop is another one"
    micro = {
        "closed loop, compiled C, every signal logged": best(simulated(True)) / CYCLES,
        "closed loop, CasADi virtual machine, every signal logged": best(simulated(False)) / CYCLES,
        "closed loop, pure Python floats, states logged": best(python_floats, 3) / CYCLES,
        "closed loop, Python loop of plain Function calls": best(plain_calls, 3) / (CYCLES // 10),
        "controller alone, stepped by hand, compiled C": best(stepped(True)) / CYCLES,
        "controller alone, stepped by hand, virtual machine": best(stepped(False)) / CYCLES,
    }
    base = micro["closed loop, compiled C, every signal logged"]
    rows = [(name, f"{1e6 * value:.2f}", f"{value / base:.1f}") for name, value in micro.items()]
    rows.append(("`fpirhc --help`, seconds", f"{help_time():.2f}", ""))
    write_table(
        "closed loop",
        ("two_mass, CTC with eq (6), 10 s at 1 kHz", "microseconds per cycle", "times the compiled loop"),
        rows,
    )


if __name__ == "__main__":
    main()
