"""The plants of other packages, every controller: rms errors after the start, and the movement of the commands.

.venv/bin/python benchmarks/outside_table.py     # fifteen seconds; a plant whose package is missing is left out with the reason
"""

from __future__ import annotations

import numpy as np

import fpirhc as fp
from fpirhc.problem_files.shipped import missing, shipped_groups


def main() -> None:
    """Print the table."""
    for name, path in shipped_groups()["plants of other packages"].items():
        if missing(path):
            print(f"{name}: left out, {missing(path)}")
            continue
        task = fp.load_problem(str(path))
        base = np.nan
        for title, controller in task.controllers.items():
            run = fp.simulate(task.problem, controller, seed=0, compiled=False)
            errors = fp.measure(task.problem, run).rms_error
            moved = float(np.abs(np.diff(run["command"], axis=0)).mean())
            base = moved if title == "RHC" else base
            text = ", ".join(f"{element} {value:.3g}" for element, value in errors.items())
            print(f"{name:12s} {title:22s} {text:50s} command moves {moved / base:.3g} times as much", flush=True)


if __name__ == "__main__":
    main()
