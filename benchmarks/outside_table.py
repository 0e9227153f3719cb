"""The plants of other packages, every controller: rms errors after the start, and the movement of the commands.

.venv/bin/python benchmarks/outside_table.py     # half a minute; a plant whose package is missing is left out with the reason

The last line of each has the processor time of its whole comparison, as `fpirhc compare` makes it, with the compiler's.
"""

from __future__ import annotations

import os

import numpy as np

import fpirhc as fp
from fpirhc.problem_files.shipped import missing, shipped_groups

LONGEST = 60.0  # s, that a comparison may take in a workflow


def spent() -> float:
    """Return the processor time of this process and of those that it has started and that have ended, s."""
    return sum(os.times()[:4])


def main() -> None:
    """Print the table."""
    for name, path in shipped_groups()["plants of other packages"].items():
        if missing(path):
            print(f"{name}: left out, {missing(path)}")
            continue
        task = fp.load_problem(str(path))
        begun, base = spent(), np.nan
        comparison = fp.compare(task, seed=0)
        took = spent() - begun
        for entry in comparison.entries:
            errors = fp.measure(task.problem, entry.run).rms_error
            moved = float(np.abs(np.diff(entry.run["command"], axis=0)).mean())
            base = moved if entry.name == "RHC" else base
            text = ", ".join(f"{element} {value:.3g}" for element, value in errors.items())
            print(f"{name:12s} {entry.name:22s} {text:50s} command moves {moved / base:.3g} times as much", flush=True)
        print(f"{name:12s} compared in {took:.0f} s of processor time, of {LONGEST:.0f}", flush=True)


if __name__ == "__main__":
    main()
