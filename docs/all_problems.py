"""The table of all problems, from the tables in their files: python docs/all_problems.py [--rivals [PROBLEM ...]].

A test compares the tables in the files with the baselines. --rivals runs PID by pole placement on the model, ADRC, and, where
the file has no rival, its own plan with a filter of disturbances, each over a grid of one rate or drift, with seed 0, and
writes the best to docs/rivals.json; it takes ten minutes.
"""

from __future__ import annotations

import ast
import json
import math
import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from math import inf
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.shipped import missing, stated

PROBLEMS = Path(__file__).resolve().parents[1] / "problems"
TRIED = Path(__file__).resolve().parent / "rivals.json"
HEADS = ("problem", "quantity", "plain", "with FPI", "best rival", "exact model", "winner")
PLAIN = ("RHC", "CTC", "CT", "pump alone", "static map", "static inverse")
OWN = re.compile(r"(RHC|CTC|CT|slots|static)\b(?!.*(offset-free|RLS))")  # rows of the iteration and its plain forms
DRAW, LOST = 1.1, 10.0  # ratios of errors
SHARES, DRIFTS = (0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3), tuple(10.0**k for k in range(-3, 4))


def files() -> list[Path]:
    """The problems of the table."""
    return [path for folder in ("", "gallery", "outside") for path in sorted((PROBLEMS / folder).glob("*.py"))]


def table() -> str:
    """The table as Markdown, and below it why the winner of each problem wins."""
    tried = json.loads(TRIED.read_text(encoding="utf-8"))
    rows = [HEADS, ("---",) * len(HEADS), *(row_of(path, tried.get(path.stem)) for path in files())]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([*lines, "", *(f"- *{path.stem}*: {stated(path, 'why', '')}" for path in files()), ""])


def errors_in(path: Path) -> tuple[str, dict[str, float]]:
    """The first quantity of a problem, and its error by controller, from the table in the file."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    head, *lines = text.partition("rms error, seed 0 ")[2].split("\n\n")[0].splitlines()
    cells = [re.split(r" {2,}", line.strip()) for line in lines]
    return head.split("[")[0].strip(), {name: float(error) for name, error, *_ in cells}


def row_of(path: Path, tried: tuple[str, float] | None) -> tuple[str, ...]:
    """The cells of a problem.

    Args:
        path: its file.
        tried: name and error of the best rival of --rivals.
    """
    quantity, errors = errors_in(path)
    adapted = {n: e for n, e in errors.items() if "no FPI" not in n and re.search("FPI|ascade|MRAC", n)}
    exact = {n: e for n, e in errors.items() if "exact" in n}
    plain = {n: e for n, e in errors.items() if n in PLAIN}
    rivals = {n: e for n, e in errors.items() if n not in adapted | exact and not OWN.match(n) and n not in PLAIN}
    lost = tried is not None and tried[1] > LOST * max(e for n, e in errors.items() if n not in exact)
    if tried is not None and not lost:
        rivals[tried[0]] = tried[1]
    base = {"RHC": plain["RHC"]} if "RHC" in plain else plain
    shown = [*map(_best, (base, adapted, rivals, exact))]
    shown[2] = "none holds it" if lost and not rivals else shown[2]
    kept = stated(path, "keeps_rule", None)
    safe = [{n: e for n, e in some.items() if kept is None or n in kept} for some in (plain, adapted, rivals)]
    return path.stem, quantity, *shown, _winner(*safe)


def _best(errors: dict[str, float]) -> str:
    name = min(errors, key=errors.__getitem__, default="")
    return f"{errors[name]:.2g} ({name})" if name else "-"


def _winner(plain: dict[str, float], adapted: dict[str, float], rivals: dict[str, float]) -> str:
    """Who has the smallest number, of the rows that keep the problem's rule."""
    if not plain | adapted | rivals:
        return "none keeps the rule"
    without, own, rival = (min(some.values(), default=inf) for some in (plain, adapted, rivals))
    if min(own, rival) * DRAW > without:
        return "nobody"
    if rival == inf:
        return "FPI, no rival"
    return "draw" if max(own, rival) <= DRAW * min(own, rival) else "FPI" if own < rival else "rival"


def candidates(task: Task, *, filters: bool) -> Iterator[tuple[str, Controller]]:
    """Rivals by name, with their settings; filters: plans with one among them."""
    problem, plant = task.problem, task.problem.plant
    gains = plant.equations.input_gain(problem.start_state, problem.inputs_before, plant.approximate).full()
    for share in SHARES:
        rate = share / problem.period
        yield f"PID, rate {rate:.2g}", placed(plant.controlled_names, plant.chains, gains, rate)
        yield f"ADRC, bandwidth {rate:.2g}", fp.rivals.ADRC(bandwidth=rate, observer=3 * rate)
    plan = next((task.controllers[n] for n in ("RHC", "RHC, predicted") if n in task.controllers), None)
    if plan is None:
        return
    for drift in DRIFTS if filters else ():
        measured = dict.fromkeys(problem.sensing.measured or plant.state.elements, 1e-3)
        filter = fp.DisturbanceKalman(drift=dict.fromkeys(plant.controlled_names, drift), measured=measured)
        yield f"RHC offset-free, drift {drift:g}", fp.Estimating(plan, filter, at_once=True)


def placed(names: tuple[str, ...], orders: Mapping[str, int], gains: np.ndarray, rate: float) -> fp.PID:
    """PID with all poles of the model's chain of integrators at -rate: (s + rate)^(r + 1)."""
    integral, proportional, derivative = {}, {}, {}
    for k, name in enumerate(names):
        n, gain = orders[name], float(gains[k, k])
        one = [math.comb(n + 1, j) * rate ** (n + 1 - j) / gain for j in range(n + 1)]
        integral[name], proportional[name], derivative[name] = one[0], one[1], one[2:]
    return fp.PID(proportional, integral, derivative)


def errors_of(task: Task, controller: Controller) -> dict[str, float]:
    """The rms errors of a run; none where it is refused or ends early."""
    try:
        run = fp.simulate(task.problem, controller, seed=0, compiled=False)
    except (fp.FpirhcError, RuntimeError):
        return {}
    return dict(fp.measure(task.problem, run).rms_error) if run.stop is None else {}


def best_rival(path: Path) -> tuple[str, float] | None:
    """Name and error of the best one: that with the smallest of its largest errors, each over that of the first row."""
    task, quantity = fp.load_problem(str(path)), errors_in(path)[0]
    first = errors_of(task, next(iter(task.controllers.values())))
    found = {}
    for name, controller in candidates(task, filters=row_of(path, None)[4] == "-"):
        own = errors_of(task, controller)
        if quantity in own:
            found[name] = max(own[n] / max(first[n], 1e-300) for n in own), own[quantity]
    if not found:
        return None
    name = min(found, key=found.__getitem__)
    return name, float(f"{found[name][1]:.3g}")


def main(words: list[str]) -> None:
    """Print the table, or try rivals and write the best of each problem."""
    if words[:1] != ["--rivals"]:
        print(table(), end="")
        return
    warnings.simplefilter("ignore")
    known = json.loads(TRIED.read_text(encoding="utf-8"))
    for path in files():
        if not missing(path) and (not words[1:] or path.stem in words):
            known[path.stem] = best_rival(path) or known.get(path.stem)
            print(path.stem, known[path.stem], flush=True)
    rows = (f"{json.dumps(name)}: {json.dumps(one)}" for name, one in sorted(known.items()) if one)
    TRIED.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
