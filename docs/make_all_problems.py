"""Writes the page of all problems from their baselines and tables, without a run: python docs/make_all_problems.py"""

from __future__ import annotations

import json
from collections.abc import Iterable
from math import inf
from pathlib import Path
from typing import Any

import fpirhc as fp
from fpirhc.controllers import rivals as named
from fpirhc.controllers.contract import resolved
from fpirhc.problem_files.shipped import missing, stated

RIVALS = {*named.__all__, "Estimating"}
DOCS = Path(__file__).resolve().parent
PROBLEMS = DOCS.parent / "problems"
PAGE, TRIED = DOCS / "all-problems.md", DOCS / "rivals.json"
ABOUT = """# All problems in one table

The first rms error of every shipped problem, or the figure that it is judged by, in its unit, seed 0; smaller is better.
`python docs/make_all_problems.py` writes the page from the baselines in the folders of `problems`, and from the tables of problems
without a baseline, which tests compare with runs; nothing is computed a second time. FPI is the best row with a deformation, the
rival the best row of `fp.rivals` or with an estimator, and the bound the row of the exact model. Beside them
`python docs/make_rivals.py` tries PID and ADRC over a grid of settings, and offset-free plans where a problem has no rival, and
writes the best to `docs/rivals.json`. It is tuned on the run that it is judged by, which the rows of the files are not, with exact
measurements of all derivatives where the problem has them. These favour a large gain, and often a PID law with its poles at a third
of the rate of the cycles is the best there is; with noise or a dead time (`noisy_motor`, `delayed_mass`) the iteration leaves less.
"None holds it" means that even the best has more than ten times the largest error of the table. A row that is not there has a dash.
An exact model that does not know a disturbance, or has one iteration per plan, is no bound. Within a tenth it is a draw, and where
no correction lowers the error by a tenth nobody wins. Where a file says `keeps_rule`, only the rows that it names can win: the
others break the rule that its table leads with, such as at most 4 % of the time below 70 mg/dl.

Below the table a sentence says why; it is `why` of the problem's own file. With people, the error is that of the one person of the
file, and it is not what counts: the tables of `anaesthesia_people`, `anaesthesia_drawn`, `anaesthesia_monitor`, `diabetes`,
`diabetes_announced` and `diabetes_order_five` lead with the worst person.

| problem | quantity | plain | with FPI | best rival | exact model | winner |
|---|---|---|---|---|---|---|
"""
WHY = """
## Why

| problem | why the winner wins |
|---|---|
"""
DRAW, LOST = 1.1, 10.0  # ratios of errors
FIGURE = 20  # size from which two digits hide a difference
PREFIX = "rms_error."


def page() -> str:
    """The page's text."""
    tried = json.loads(TRIED.read_text(encoding="utf-8"))
    rows = [row for path in files() if (row := row_of(path, tried.get(path.stem, {})))]
    return ABOUT + _lines(row[:-1] for row in rows) + WHY + _lines((row[0], row[-1]) for row in rows)


def _lines(rows: Iterable[tuple[str, ...]]) -> str:
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def files() -> list[Path]:
    """The problems of the page."""
    return [path for folder in ("", "gallery", "outside") for path in sorted((PROBLEMS / folder).glob("*.py"))]


def row_of(path: Path, tried: dict[str, Any]) -> tuple[str, ...] | None:
    """The cells of a problem; None where it has no row with a deformation, or no numbers at all.

    Args:
        path: its file.
        tried: the best rival of `make_rivals`.
    """
    baseline = path.parent / "baselines" / f"{path.stem}.json"
    metric, errors, kinds = _of_baseline(path, baseline) if baseline.exists() else _of_table(path)
    adapted = {n: e for n, e in errors.items() if ("FPI" in n and "no FPI" not in n) or kinds[n] == "Cascade"}
    exact = {n: e for n, e in errors.items() if "exact" in n}
    plain = {n: e for n, e in errors.items() if n in ("RHC", "CTC", "CT") or kinds[n] == "FeedforwardOnly"}
    rivals = {n: e for n, e in errors.items() if n not in {*adapted, *exact} and kinds[n] in RIVALS}
    if not adapted or not plain:
        return None
    lost = bool(tried) and tried["error"] > LOST * max(e for n, e in errors.items() if n not in exact)
    if tried and not lost:
        rivals |= {tried["rival"]: tried["error"]}
    best, base = min(adapted, key=adapted.__getitem__), "RHC" if "RHC" in plain else next(iter(plain))
    rival = min(rivals, key=rivals.__getitem__, default="")
    cells = [_cell(base, plain), _cell(best, adapted), _cell(rival, rivals)]
    cells[2] = "none holds it" if lost and not rivals else cells[2]
    bound = _cell(min(exact, key=exact.__getitem__, default=""), exact)
    kept = stated(path, "keeps_rule", None)
    plain, adapted, rivals = (
        {n: e for n, e in one.items() if kept is None or n in kept} for one in (plain, adapted, rivals)
    )
    return path.stem, metric, *cells, bound, _winner(plain, adapted, rivals), stated(path, "why", "")


def _of_baseline(path: Path, stored: Path) -> tuple[str, dict[str, float], dict[str, str]]:
    """The figure that the problem is judged by, or its first quantity; by controller its number and what the controller is."""
    baseline = json.loads(stored.read_text(encoding="utf-8"))
    controllers, kinds = baseline["controllers"], baseline["settings"]["controllers"]
    first = next(iter(controllers.values()))["metrics"]
    own = None if missing(path) else fp.load_problem(str(path)).headline_metric
    metric = own or next((m for m in first if m.startswith(PREFIX)), "")
    errors = {n: float(c["metrics"][metric]["value"]) for n, c in controllers.items() if metric in c["metrics"]}
    return metric.removeprefix(PREFIX), errors, {n: kinds[n]["is"] for n in errors}


def _of_table(path: Path) -> tuple[str, dict[str, float], dict[str, str]]:
    """The same from the description."""
    task = fp.load_problem(str(path))
    table = task.description.partition("    rms error, seed 0 ")[2]
    head, *lines = table.split("\n\n")[0].splitlines()
    rows = [[cell.strip() for cell in line.split("  ") if cell.strip()] for line in lines]
    kinds = {n: type(resolved(task.problem, task.controllers[n])).__name__ for n, *_ in rows}
    return head.split("[")[0].strip(), {n: float(number) for n, number, *_ in rows}, kinds


def _cell(name: str, errors: dict[str, float]) -> str:
    if name not in errors:
        return "-"
    return f"{errors[name]:.{2 if errors[name] < FIGURE else 4}g} ({name})"


def _winner(plain: dict[str, float], adapted: dict[str, float], rivals: dict[str, float]) -> str:
    """Who has the smallest number, of the rows that keep the problem's rule."""
    if not {**plain, **adapted, **rivals}:
        return "none keeps the rule"
    without, own, rival = (min(one.values(), default=inf) for one in (plain, adapted, rivals))
    if min(own, rival) * DRAW > without:
        return "nobody"
    if rival == inf:
        return "FPI, no rival"
    if max(own, rival) <= DRAW * min(own, rival):
        return "draw"
    return "FPI" if own < rival else "rival"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
