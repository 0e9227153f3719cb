"""Keeps what every shipped loop computes, to the last bit, and says which loops compute something else now."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.errors import FpirhcError
from fpirhc.problem_files.shipped import missing, shipped_groups

CYCLES = 300  # of every loop, in the virtual machine: the compiler has no say

Loops = dict[str, dict[str, str]]


def main() -> int:
    """Write the digests of all loops, or compare them with those of a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("action", choices=("save", "compare"))
    parser.add_argument("file", type=Path, help="JSON with a digest of every signal of every loop")
    parser.add_argument("problems", nargs="*", help="names of problems; none: all of them")
    parser.add_argument("--processes", type=int, default=1)
    chosen = parser.parse_args()
    names = chosen.problems or [n for every in shipped_groups().values() for n, p in every.items() if not missing(p)]
    with ProcessPoolExecutor(chosen.processes) as pool:
        loops = {loop: signals for part in pool.map(digests, names) for loop, signals in part.items()}
    if chosen.action == "save":
        chosen.file.write_text(json.dumps(loops, indent=1), encoding="utf-8")
        print(f"{len(loops)} loops saved")
        return 0
    before = {k: v for k, v in json.loads(chosen.file.read_text(encoding="utf-8")).items() if k.split(": ")[0] in names}
    differences = list(compared(before, loops))
    print(*differences, f"{len(before)} loops before, {len(loops)} now, {len(differences)} differ", sep="\n")
    return bool(differences)


def digests(name: str) -> Loops:
    """Return a digest of every signal of every controller of a problem; of a refused loop its sentence."""
    task = fp.load_problem(name)
    problem = replace(task.problem, duration=min(task.problem.duration, CYCLES * task.problem.period), measure_from=0.0)
    found: Loops = {}
    for title, controller in task.controllers.items():
        try:
            run = fp.simulate(problem, controller, seed=0, compiled=False)
        except FpirhcError as error:
            found[f"{name}: {title}"] = {"refused": str(error)}
            continue
        found[f"{name}: {title}"] = {signal.name: _digest(run[signal.name]) for signal in run.layout.signals}
    return found


def _digest(values: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


def compared(before: Loops, now: Loops) -> Iterator[str]:
    """Yield a sentence for every loop that is gone, or has changed a signal. Signals that no loop has any more are none."""
    logged = {name for signals in now.values() for name in signals}
    for loop, signals in before.items():
        if loop not in now:
            yield f"{loop}: not there any more"
            continue
        changed = [name for name, digest in signals.items() if name in logged and now[loop].get(name) != digest]
        if changed:
            yield f"{loop}: {', '.join(changed)}"


if __name__ == "__main__":
    sys.exit(main())
