"""Writes the page of all problems from their baselines and tables, without a run: python docs/make_all_problems.py"""

from __future__ import annotations

import json
from pathlib import Path

import fpirhc as fp
from fpirhc.controllers import rivals as named
from fpirhc.problem_files.shipped import missing

RIVALS = {*named.__all__, "Estimating"}
DOCS = Path(__file__).resolve().parent
PROBLEMS = DOCS.parent / "problems"
PAGE = DOCS / "all-problems.md"
ABOUT = """# All problems in one table

The first rms error of every shipped problem, in its unit, seed 0. `python docs/make_all_problems.py` writes the page from
`problems/baselines` and `problems/gallery/baselines`, and from the tables of problems without a baseline, which tests compare with
runs; nothing is computed a second time. FPI is the best row with a deformation, the rival the best row of `fp.rivals` or with an
estimator, and the bound the row of the exact model. A row that is not there has a dash. An exact model that does not know a
disturbance, or has one iteration per plan, is no bound. Within a tenth it is a draw. Problems that are judged by another figure
than an error are not here: `anaesthesia_people`, `anaesthesia_monitor`, `diabetes`, `diabetes_announced`, `diabetes_order_five`
and `freeway_economic` have tables of their own.

| problem | quantity | plain | with FPI | best rival | exact model | winner | why |
|---|---|---|---|---|---|---|---|
"""
DRAW = 1.1
PREFIX = "rms_error."


def page() -> str:
    """The page's text."""
    files = [*sorted(PROBLEMS.glob("*.py")), *sorted(PROBLEMS.glob("gallery/*.py"))]
    return ABOUT + "".join(f"| {' | '.join(row)} |\n" for row in filter(None, map(_row, files)))


def _row(path: Path) -> tuple[str, ...] | None:
    """The cells of a problem; None where it is judged otherwise or has no row with a deformation."""
    baseline = path.parent / "baselines" / f"{path.stem}.json"
    metric, errors, kinds = _of_baseline(baseline) if baseline.exists() else _of_table(path)
    adapted = {n: e for n, e in errors.items() if ("FPI" in n and "no FPI" not in n) or kinds[n] == "Cascade"}
    exact = {n: e for n, e in errors.items() if "exact" in n}
    plain = {n: e for n, e in errors.items() if n in ("RHC", "CTC", "CT") or kinds[n] == "FeedforwardOnly"}
    rivals = {n: e for n, e in errors.items() if n not in {*adapted, *exact} and kinds[n] in RIVALS}
    if not adapted or not plain:
        return None
    best, base = min(adapted, key=adapted.__getitem__), "RHC" if "RHC" in plain else next(iter(plain))
    rival = min(rivals, key=rivals.__getitem__, default="")
    cells = [_cell(base, plain), _cell(best, adapted), _cell(rival, rivals)]
    bound = _cell(min(exact, key=exact.__getitem__, default=""), exact)
    return path.stem, metric, *cells, bound, *_judged(plain, adapted[best], rivals.get(rival))


def _of_baseline(path: Path) -> tuple[str, dict[str, float], dict[str, str]]:
    """The first quantity, and by controller its rms error and what the controller is."""
    baseline = json.loads(path.read_text(encoding="utf-8"))
    controllers, kinds = baseline["controllers"], baseline["settings"]["controllers"]
    first = next(iter(controllers.values()))["metrics"]
    metric = next((m for m in first if m.startswith(PREFIX)), "")
    errors = {n: float(c["metrics"][metric]["value"]) for n, c in controllers.items() if metric in c["metrics"]}
    return metric.removeprefix(PREFIX), errors, {n: kinds[n]["is"] for n in errors}


def _of_table(path: Path) -> tuple[str, dict[str, float], dict[str, str]]:
    """The same from the description; nothing where the problem is judged by another figure, or its packages are missing."""
    if missing(path):
        return "", {}, {}
    task = fp.load_problem(str(path))
    _, found, table = task.description.partition("    rms error, seed 0 ")
    if task.headline_metric or not found:
        return "", {}, {}
    head, *lines = table.split("\n\n")[0].splitlines()
    rows = [[cell.strip() for cell in line.split("  ") if cell.strip()] for line in lines]
    kinds = {n: type(task.controllers[n]).__name__ for n, *_ in rows}
    return head.split("[")[0].strip(), {n: float(number) for n, number, *_ in rows}, kinds


def _cell(name: str, errors: dict[str, float]) -> str:
    return f"{errors[name]:.2g} ({name})" if name in errors else "-"


def _judged(plain: dict[str, float], adapted: float, rival: float | None) -> tuple[str, str]:
    """The winner, and the sentence that says by how much."""
    without = min(plain.values())
    gain = f"the iteration leaves {adapted / without:.2g} of the error without adaptation"
    if adapted * DRAW > without and (rival is None or rival * DRAW > without):
        return "nobody", "no correction lowers the error by a tenth"
    if rival is None:
        return "FPI, no rival run", gain
    if max(adapted, rival) <= DRAW * min(adapted, rival):
        return "draw", f"{gain}, and the rival as much"
    if adapted < rival:
        return "FPI", f"{gain}; the rival has {rival / adapted:.3g} times as much left"
    return "rival", f"{gain}, {adapted / rival:.3g} times as much as the rival"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
