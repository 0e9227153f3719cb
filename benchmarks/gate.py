"""What the gate of bad samples costs on two_mass: with it and without it, side by side in one run.

    python benchmarks/gate.py            prints a table; --write puts it into docs/performance.md

Process time of the compiled loop over 10 s of 1 kHz, and of 10 000 steps by hand, with and without the gate, in turns that change
places. The difference is the median of the quotients of pairs that ran one after the other, with their quartiles; times are the
best. Without the gate the same composed controller stands in the same loop, and nothing is checked, held or counted.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np

import fpirhc as fp
from fpirhc.controllers.gate import HELD, Gate
from fpirhc.simulation.simulate import simulator
from fpirhc.symbolic.block import GAPS, Block
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal

sys.path.insert(0, str(Path(__file__).resolve().parent))
from in_turns import Work, compared, loop_time
from table import write_table

two_mass = cache(lambda: fp.load_problem("two_mass"))
CONTROLLERS = ("CTC", "CTC+FPI (eq 6)", "RHC", "RHC+FPI")
REPEATS = 41
STEPS = 10_000  # by hand
WHOLE = {gap.name for gap in GAPS}  # what no gate says of samples that are never lost


class Open(Gate):
    """No gate: every sample is given to the controller."""

    @property
    def memory(self) -> Layout:
        """The controller's memory, and the last command, which the check of jumps in front of a gate reads."""
        plant = self.problem.plant
        return Layout((Signal(HELD, plant.input.elements, plant.input.units),)) + self.controller_memory

    def block(self) -> Block:
        """The controller's step as one block."""
        own, trace = self.controller_memory, self.inner.trace

        def step(s: Signals) -> dict[str, Expression]:
            memory = own.join({m: getattr(s, m) for m in own.names})
            sample = [expression(0.0) if r in WHOLE else getattr(s, r) for r in self.inner.reads.names]
            memory_next, shown, command = self.inner.function(memory, *sample)
            following = {f"{m}_next": v for m, v in own.split(memory_next).items()}
            return {**trace.split(shown), "command": command, **following, f"{HELD}_next": command}

        return Block("open", self.reads, trace, step, self.memory, opaque=self.inner.opaque, inside=self.inner)


@contextmanager
def no_gate() -> Iterator[None]:
    """Loops and steps that are built here have no gate."""
    with patch("fpirhc.simulation.loop.Gate", Open), patch("fpirhc.simulation.machine.Gate", Open):
        yield


def cycles(name: str) -> Work:
    """Process time of the compiled loop alone."""
    return loop_time(simulator(two_mass().problem, two_mass().controllers[name]))


def steps(name: str) -> Work:
    """Process time of steps by hand with the first sample, a period apart, the memory handed on."""
    stepper = fp.Stepper(two_mass().problem, two_mass().controllers[name])
    state, realised = two_mass().problem.start_state, np.zeros(len(two_mass().problem.plant.inputs))
    times = [k * two_mass().problem.period for k in range(STEPS)]

    def work() -> float:
        memory = stepper.start()
        begin = time.process_time()
        for t in times:
            _, memory = stepper.step(t, state, realised, memory)
        return time.process_time() - begin

    return work


def price(name: str, what: str, make: Callable[[str], Work], count: int) -> list[str]:
    """Row: microseconds without and with the gate, and the ratio."""
    with no_gate():
        works = [make(name)]
    works.append(make(name))
    return [f"{name}, {what}", *compared(works, count, REPEATS)]


def main() -> None:
    """Measure and print."""
    rows = [price(name, "loop", cycles, two_mass().problem.cycles) for name in CONTROLLERS]
    rows += [price(name, "step by hand", steps, STEPS) for name in CONTROLLERS]
    write_table("gate", ("", "without the gate", "with it", "difference"), rows)


if __name__ == "__main__":
    main()
