"""A baseline is a JSON file beside the problem, with value and band of every metric of every controller; `check` compares with it.

The bands come from runs that should agree: with other seeds where there is noise, with parameters moved by rounding, with twice the
integrator's steps, and in CasADi's virtual machine.
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from fpirhc.errors import InvalidValue, writing
from fpirhc.fields.checked import checked_call
from fpirhc.problem_files.problem_file import Task, load_problem
from fpirhc.problem_files.shipped import missing, problem_files
from fpirhc.studies import Progress, versions
from fpirhc.studies.compare import select
from fpirhc.studies.runs import run_variants
from fpirhc.studies.variants import Variant, Variants
from fpirhc.whole_file import write_whole

FACTOR, TIGHT, SEEDS = 3.0, 1e-6, 8  # of the spread, of the value, and of noise
# Metrics of a baseline.
KEPT = "rms_error", "max_error", "effort", "total_variation", "at_limit", "in_band", "distance"


@dataclass(frozen=True)
class Repeats(Variants):
    """The problem as it stands, and runs that should agree with it."""

    seed: int = 0
    seeds: int = 1  # 1: the problem alone

    def of(self, task: Task) -> Sequence[Variant]:
        problem, seed = task.problem, self.seed
        every = [Variant("nominal", problem, "nominal", seed=seed)]
        if self.seeds > 1 and problem.moves.simulated:
            moved = problem.with_exact(problem.real_parameters * (1 + 1e-14))
            every.append(Variant("rounding", moved, "nominal", seed=seed))
            if (finer := problem.integrator.finer(2)) is not None:
                every.append(Variant("finer steps", replace(problem, integrator=finer), "finer", seed=seed))
        if problem.random:
            seeds = range(seed + 1, seed + self.seeds)
            every += [Variant(f"seed {k}", problem, "nominal", seed=k) for k in seeds]
        return every


def baseline_path(task_file: Path, folder: Path | None = None) -> Path:
    """Return the path of the baseline of a problem file."""
    return (folder or task_file.parent / "baselines") / f"{task_file.stem}.json"


def file_hash(path: Path) -> str:
    """Return 16 hexadecimal digits of a problem file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def written(facts: dict[str, Any]) -> str:
    """Return the text of a baseline, with a line for every controller."""
    rows = ",\n".join(
        f"  {json.dumps(n)}: {json.dumps(one, allow_nan=False)}" for n, one in facts["controllers"].items()
    )
    head = json.dumps({key: value for key, value in facts.items() if key != "controllers"}, indent=1, allow_nan=False)
    return f'{head[:-2]},\n "controllers": {{\n{rows}\n }}\n}}\n'


def _numbers(rows: pd.DataFrame) -> dict[str, dict[str, list[float]]]:
    """By controller and metric, the values of all rows, the nominal one first."""
    columns = [str(c) for c in rows if str(c).partition(".")[0] in KEPT]
    return {
        str(n): {c: some[c].tolist() for c in columns if some[c].notna().all()}
        for n, some in rows.groupby("controller", sort=False)
    }


@checked_call
def accept(
    task: Task,
    reason: str,
    *,
    seed: int = 0,
    seeds: int = SEEDS,
    baselines: Path | None = None,
    processes: int = 1,
    compiled: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Measure every controller, write the baseline with the reason, and return its path."""
    if not reason.strip():
        raise InvalidValue("a new baseline needs a reason: say why the new numbers are right")
    rows = run_variants(task, Repeats(seed, seeds), processes=processes, compiled=compiled, progress=progress)
    interpreted = run_variants(task, Repeats(seed), processes=processes, compiled=False, progress=progress)
    rows = pd.concat([rows, interpreted])
    controllers: dict[str, Any] = {}
    for name, metrics in _numbers(rows).items():
        own = {m.name: m for m in task.metrics}
        outcomes = sorted(set(rows.loc[rows.controller == name, "outcome"]))
        expected = {}
        for metric, values in metrics.items():
            spread = max(values) - min(values)
            names = metric, metric.rpartition(".")[0], metric.partition(".")[0]
            band = max(FACTOR * spread, TIGHT * abs(values[0]), own[next(k for k in names if k in own)].floor)
            if math.isfinite(values[0] + band):
                expected[metric] = [values[0], float(f"{1.005 * band:.3g}")]
        controllers[name] = {"outcomes": outcomes, "metrics": expected}
    facts: Any = {
        "problem": task.name,
        "reason": reason.strip(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    facts |= {"seed": seed, "versions": versions(), "file": file_hash(task.path), "controllers": controllers}
    path = baseline_path(task.path, baselines)
    with writing(path.parent, "--baselines"):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(written(facts), path, "baseline")
    return path


@dataclass(frozen=True, eq=False)
class Judgement:
    """A problem beside its baseline."""

    problem: str
    rows: pd.DataFrame  # controller, metric, expected, band, fresh, holds
    stale: str = ""  # that the file is not the one that was accepted
    unusable: str = ""  # why there is no comparison

    @property
    def changed(self) -> pd.DataFrame:
        """The rows that do not hold, the largest change first."""
        return self.rows.loc[~self.rows.holds]

    @property
    def holds(self) -> bool:
        """Whether there is a comparison, and all of it holds."""
        return not self.unusable and len(self.rows) > 0 and bool(self.rows.holds.all())

    @property
    def text(self) -> str:
        """What is said of it, with a table of what changed."""
        if self.unusable:
            return f"{self.problem}: {self.unusable}"
        if self.holds:
            return f"{self.problem}: {len(self.rows)} metrics hold{self.stale and f'; {self.stale}'}"
        head = f"{self.problem}: {self.stale}\n" if self.stale else ""
        changed = f"{len(self.changed)} of {len(self.rows)} metrics changed\n{self.changed.to_string(index=False)}"
        return f"{head}{self.problem}: {changed}"


@checked_call
def check(
    task: Task | str,
    *,
    controllers: Sequence[str] | None = None,
    baselines: Path | None = None,
    ignore: float = 0.0,
    processes: int = 1,
    compiled: bool = True,
    progress: Progress | None = None,
) -> Judgement:
    """Measure a problem's controllers and compare them with its baseline; changes below a share `ignore` of a value hold."""
    task = load_problem(task) if isinstance(task, str) else task
    path, none = baseline_path(task.path, baselines), pd.DataFrame({"holds": pd.Series(dtype=bool)})
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        asked, seed = list(select(task, controllers)), int(facts["seed"])
        if unknown := [name for name in asked if name not in facts["controllers"]]:
            text = f"'{path.name}' has no row of {', '.join(map(repr, unknown))}; measure it again: fpirhc accept"
            return Judgement(task.name, none, unusable=text)
        known = {name: facts["controllers"][name] for name in asked}
        expected = {n: {m: (float(v), float(b)) for m, (v, b) in one["metrics"].items()} for n, one in known.items()}
    except FileNotFoundError:
        text = f"there is no baseline '{path.name}'; write one: fpirhc accept {task.path} --reason ..."
        return Judgement(task.name, none, unusable=text)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        text = f"'{path.name}' is no whole baseline ({error!r}); measure it again: fpirhc accept"
        return Judgement(task.name, none, unusable=text)
    stale = "the problem file changed since it was accepted" if facts["file"] != file_hash(task.path) else ""
    how: dict[str, Any] = {"processes": processes, "compiled": compiled, "progress": progress}
    fresh, rows = run_variants(task, Repeats(seed), controllers=list(known), **how), []
    for row in fresh.to_dict("records"):
        name = row["controller"]
        if row["outcome"] not in known[name]["outcomes"]:
            before = ", ".join(known[name]["outcomes"])
            rows.append({"controller": name, "metric": "outcome", "expected": before, "fresh": row["outcome"]})
        for metric, (value, band) in expected[name].items():
            new = float(row.get(metric, math.nan))
            one = {"controller": name, "metric": metric, "expected": value, "band": band, "fresh": new}
            rows.append(one | {"holds": abs(new - value) <= max(band, ignore * abs(value))})
    table = pd.DataFrame(rows).assign(holds=lambda t: t.holds.eq(True))
    now, then = (pd.to_numeric(table[column], errors="coerce") for column in ("fresh", "expected"))
    size = (now / then - 1).abs().fillna(math.inf)
    return Judgement(task.name, table.loc[size.sort_values(ascending=False).index], stale)


def problems_here(folder: Path) -> list[Path]:
    """Return the problem files of a folder, or of its folder 'problems', whose packages are installed.

    Those that a file baselines/unchecked.toml beside them names, with the reason, are left out.
    """
    place = folder / "problems" if (folder / "problems").is_dir() else folder
    found = list[Path]()
    for inner in (place, *sorted(one for one in place.iterdir() if one.is_dir())):
        reasons = inner / "baselines" / "unchecked.toml"
        unchecked = tomllib.loads(reasons.read_text(encoding="utf-8")) if reasons.is_file() else {}
        found += [one for one in problem_files(inner) if one.stem not in unchecked and not missing(one)]
    if not found:
        raise InvalidValue(f"no problem to check in '{place}'; name one, as in fpirhc check two_mass")
    return found
