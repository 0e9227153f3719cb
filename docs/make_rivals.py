"""Tries rivals on every shipped problem that needs no other package, and writes the best: python docs/make_rivals.py [PROBLEM ...]

Tried are PID by pole placement on the model, ADRC, and, where the file has no rival, its own plan with a filter that estimates
disturbances, each over a grid of one rate or one drift; the errors are those of whole runs with seed 0, on which they are tuned. It
takes ten minutes.
"""

from __future__ import annotations

import json
import math
import sys
import warnings
from collections.abc import Iterator

import make_all_problems as page

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.shipped import needed

SHARES = (0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3)  # rate times period
DRIFTS = tuple(10.0**k for k in range(-3, 4))  # of a disturbance, beside deviations of 1e-3 of all measured states


def tried(task: Task, *, filters: bool) -> Iterator[tuple[str, Controller]]:
    """Rivals by name, with their settings; filters: plans with one among them."""
    problem, plant = task.problem, task.problem.plant
    names = plant.controlled_names
    for share in SHARES:
        rate = share / problem.period
        yield f"PID, rate {rate:.2g}", placed(task, rate)
        yield f"ADRC, bandwidth {rate:.2g}", fp.rivals.ADRC(bandwidth=rate, observer=3 * rate)
    plan = next((task.controllers[n] for n in ("RHC", "RHC, predicted") if n in task.controllers), None)
    for drift in DRIFTS if filters and plan is not None else ():
        states = problem.sensing.measured or plant.state.elements
        filter = fp.DisturbanceKalman(drift=dict.fromkeys(names, drift), measured=dict.fromkeys(states, 1e-3))
        yield f"RHC offset-free, drift {drift:g}", fp.Estimating(plan, filter, at_once=True)


def placed(task: Task, rate: float) -> fp.rivals.PID:
    """PID with all poles of the model's chain of integrators at -rate: (s + rate)^(r + 1)."""
    problem, plant = task.problem, task.problem.plant
    gains = plant.equations.input_gain(problem.start_state, problem.inputs_before, plant.approximate).full()
    proportional, integral, derivative = {}, {}, {}
    for k, name in enumerate(plant.controlled_names):
        order, b = plant.chains[name], float(gains[k, k])
        one = [math.comb(order + 1, j) * rate ** (order + 1 - j) / b for j in range(order + 1)]
        integral[name], proportional[name], derivative[name] = one[0], one[1], one[2:]
    return fp.rivals.PID(proportional, integral, derivative)


def best(task: Task, metric: str, *, filters: bool) -> dict[str, float | str] | None:
    """The name of the best rival and its error; None where none runs to the end.

    The best one has the smallest of its largest errors, each over that of the first row: no pole falls while its cart is held.
    """
    first = errors(task, next(iter(task.controllers.values())))
    found: dict[str, tuple[float, float]] = {}
    for name, controller in tried(task, filters=filters):
        own = errors(task, controller)
        if metric in own:
            found[name] = max(own[n] / max(first[n], 1e-300) for n in own), own[metric]
    name = min(found, key=found.__getitem__, default=None)
    return None if name is None else {"rival": name, "error": float(f"{found[name][1]:.3g}")}


def errors(task: Task, controller: Controller) -> dict[str, float]:
    """The rms errors of a run; none where it is refused or ends early."""
    try:
        run = fp.simulate(task.problem, controller, seed=0, compiled=False)
    except (fp.FpirhcError, RuntimeError):
        return {}
    return dict(fp.measure(task.problem, run).rms_error) if run.stop is None else {}


def main(names: list[str]) -> None:
    """Write the file, problem by problem."""
    warnings.simplefilter("ignore")
    known = json.loads(page.TRIED.read_text(encoding="utf-8")) if page.TRIED.exists() else {}
    for path in page.files():
        row = None if needed(path) else page.row_of(path, {})
        if row is None or (names and row[0] not in names):
            continue
        one = best(fp.load_problem(str(path)), row[1], filters=row[4] == "-")
        if one is not None:
            known[path.stem] = one
        print(path.stem, one, flush=True)
        page.TRIED.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
