"""What a plan in every cycle changes in every shipped problem whose stages are longer and that plans once per stage.

.venv/bin/python benchmarks/plan_rates.py                        # all of them: some minutes
.venv/bin/python benchmarks/plan_rates.py two_link_arm tumour

Printed are rms errors over those with a plan per stage, in the mean over the coordinates, without adaptation and with it.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import fpirhc as fp
from fpirhc.errors import FpirhcError
from fpirhc.probing.rule import mean_ratio
from fpirhc.problem_files.shipped import missing, shipped_groups
from fpirhc.simulation.run import Run
from fpirhc.simulation.trials import weighed

CONTROLLERS = ("RHC", "RHC+FPI")


def ratio(problem: fp.Problem, controller: fp.Controller) -> float | str:
    """Return the errors with a plan in every cycle over those with a plan per stage; a text where there are none."""

    def run(rate: str) -> Run:
        return fp.simulate(replace(problem, horizon=replace(problem.horizon, replan=rate)), controller, seed=0)

    try:
        stage, cycle = run("stage"), run("cycle")
    except FpirhcError as error:
        return f"refused ({str(error).splitlines()[0]})"
    if stage.stop or cycle.stop:
        return "ends early"
    return mean_ratio(problem, stage, cycle, weighed(problem, controller))


def main() -> None:
    """Print the table."""
    for name, path in ((n, p) for group in shipped_groups().values() for n, p in group.items()):
        if missing(path) or (sys.argv[1:] and name not in sys.argv[1:]):
            continue
        task = fp.load_problem(name)
        planned = {n: c for n, c in task.controllers.items() if n in CONTROLLERS}
        horizon = task.problem.horizon
        if not planned or horizon is None or horizon.replan != "stage" or horizon.step < 1.5 * task.problem.period:
            continue
        found = {n: ratio(task.problem, c) for n, c in planned.items()}
        texts = (f"{n} {one:.3f}" if isinstance(one, float) else f"{n} {one}" for n, one in found.items())
        print(f"{name:22s} {horizon.step / task.problem.period:4.0f} cycles a stage   {', '.join(texts)}", flush=True)


if __name__ == "__main__":
    main()
