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

import fpirhc as fp
from fpirhc.problem_files.settings import with_settings
from fpirhc.simulation.simulate import simulator

sys.path.insert(0, str(Path(__file__).resolve().parent))
from in_turns import compared, loop_time
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


def cost(name: str, live: Sequence[str]) -> list[str]:
    """Row: microseconds of a cycle without and with live settings, and the ratio."""
    works = [loop_time(simulator(TASK.problem, TASK.controllers[name], live=p)) for p in ((), live)]
    return [f"{name}, {len(live)} live", *compared(works, TASK.problem.cycles, REPEATS)]


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
