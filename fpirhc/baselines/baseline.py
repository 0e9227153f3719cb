"""A baseline: a readable JSON file with one metric per line, and a checksum that shows edits by hand.

The checksum is over the content: white space and the order of keys do not matter. It is no signature. The file stands beside the
problem, `baselines/NAME.json`, so that both change together; `unchecked.toml` there names problems without one, and why.
"""

from __future__ import annotations

import ast
import hashlib
import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fpirhc.baselines.measuring import FINISHED, NOMINAL, Measurement, Number, Variant, metric_of
from fpirhc.describe import FunctionName, describe
from fpirhc.errors import BaselineError, OutputError
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.shipped import missing
from fpirhc.simulation import metrics as run_metrics

FORMAT = 1
_WIDTH = 118  # of a line that holds a whole object


@dataclass(frozen=True)
class Baseline:
    """The expected results of a problem, and how they were measured."""

    problem: str  # name of the problem
    reason: str  # why this baseline was accepted
    date: str  # time of its acceptance, UTC
    seed: int  # seed of the nominal run
    versions: Mapping[str, str]  # versions of fpirhc and of what its numbers depend on
    varied: Mapping[str, Sequence[str]]  # variants in words, by source
    settings: Settings  # settings of the problem and its controllers
    controllers: Mapping[str, Expected]  # expectations by controller


def to_text(baseline: Baseline) -> str:
    """Return the file's text; its controllers are sorted by name, whatever the order of the measurements."""
    settings = asdict(baseline.settings)
    settings["controllers"] = dict(sorted(settings["controllers"].items()))
    facts = {
        "format": FORMAT,
        "problem": baseline.problem,
        "reason": baseline.reason,
        "date": baseline.date,
        "seed": baseline.seed,
        "versions": dict(baseline.versions),
        "varied": {source: list(names) for source, names in baseline.varied.items()},
        "settings": {"hash": settings_hash(baseline.settings), **settings},
        "controllers": {name: _entry(one) for name, one in sorted(baseline.controllers.items())},
    }
    facts["checksum"] = fingerprint(facts)
    return _written(facts, "", keep_open=True) + "\n"


def settings_hash(settings: Settings) -> str:
    """Return the hash of all settings."""
    return fingerprint(asdict(settings))


def _entry(one: Expected) -> dict[str, Any]:
    metrics = {name: _metric_facts(asdict(metric)) for name, metric in one.metrics.items()}
    return {"outcomes": list(one.outcomes), "metrics": metrics, "not_compared": dict(one.not_compared)}


def _metric_facts(facts: dict[str, Any]) -> dict[str, Any]:
    """An exact metric has neither band nor spread."""
    return facts if facts["band"] else {"kind": facts["kind"], "value": facts["value"]}


def _written(value: Any, indent: str, *, keep_open: bool = False) -> str:
    """JSON in which every object that fits on a line stands on one."""
    line = json.dumps(value, ensure_ascii=True, allow_nan=False)
    if not isinstance(value, dict) or not value or (len(indent) + len(line) <= _WIDTH and not keep_open):
        return line
    deeper = indent + "  "
    inside = ",\n".join(f"{deeper}{json.dumps(k)}: {_written(v, deeper)}" for k, v in value.items())
    return "{\n" + inside + f"\n{indent}}}"


Flat = Mapping[str, Any]

_LONG = 16  # entries of a list from which on its hash stands for it


@dataclass(frozen=True)
class Settings:
    """Flat settings.

    Args:
        problem: settings of the problem.
        controllers: settings of every controller, by name.
    """

    problem: Flat
    controllers: Mapping[str, Flat]

    def without(self, absent: set[str]) -> Settings:
        """Return the settings without some controllers."""
        return Settings(self.problem, {k: v for k, v in self.controllers.items() if k not in absent})


def settings_of(task: Task) -> Settings:
    """Return the settings of a task."""
    return Settings(_flat(task.problem), {name: _flat(controller) for name, controller in task.controllers.items()})


def fingerprint(value: Any) -> str:
    """Return a hash of plain data; the order of keys does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def differences(where: str, before: Flat, now: Flat, *, names: bool = True) -> list[str]:
    """Return a sentence for every setting that differs: 'where: name was ..., is ...'.

    `names`: whether another name of a function is a difference.
    """
    missing = object()
    sentences = []
    for name in sorted({*before, *now}):
        old, new = before.get(name, missing), now.get(name, missing)
        if not names and isinstance(new, FunctionName) and isinstance(old, str):
            continue
        if fingerprint(None if old is missing else [_by_value(old)]) != fingerprint(
            None if new is missing else [_by_value(new)]
        ):
            was = "was not there" if old is missing else f"was {json.dumps(old)}"
            now_is = "is gone" if new is missing else f"is {json.dumps(new)}"
            sentences.append(f"{where}: {name} {was}, {now_is}")
    return sentences


def _by_value(value: Any) -> Any:
    """Plain data in which 2 and 2.0 are one number."""
    if isinstance(value, list):
        return [_by_value(entry) for entry in value]
    return float(value) if type(value) is int else value


def _flat(value: Any) -> dict[str, Any]:
    settings: dict[str, Any] = {}
    _collect(describe(value), "", settings)
    return settings


def _collect(value: Any, path: str, settings: dict[str, Any]) -> None:
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            _collect(inner, f"{path}.{key}" if path else key, settings)
    elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
        for k, inner in enumerate(value):
            _collect(inner, f"{path}[{k}]", settings)
    elif isinstance(value, list) and len(json.dumps(value)) > 8 * _LONG:
        settings[path] = f"{len(value)} entries, {fingerprint(_plain(value))}"
    else:
        settings[path] = _plain(value)


def _plain(value: Any) -> Any:
    """The value for JSON, which has neither infinity nor NaN: they become words."""
    if isinstance(value, list):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


EXACT, TIGHT, BANDED = "exact", "tight", "banded"
KINDS = (EXACT, TIGHT, BANDED)
FACTOR = 3.0
RELATIVE = 1e-6  # also what 'tight' means
_LOOSE = 0.5  # share of the value above which a band shows few changes
_QUANTA = 1.5  # of a metric that counts cycles: one cycle more or less is no change


@dataclass(frozen=True)
class Metric:
    """One metric of a baseline.

    Args:
        kind: `EXACT`, `TIGHT` or `BANDED`.
        value: a number, a word, or None where the run has none (it never settles).
        band: half-width; 0 for an exact metric.
        spread: distance from the least to the largest value, by source; the band comes from the largest spread.
    """

    kind: str
    value: Number | None
    band: float
    spread: Mapping[str, float]

    @property
    def loose(self) -> bool:
        """Whether the spread is so wide that the band shows few changes."""
        return isinstance(self.value, int | float) and FACTOR * self.widest > _LOOSE * abs(self.value)

    @property
    def widest(self) -> float:
        """The largest spread of any source."""
        return max(self.spread.values(), default=0.0)


@dataclass(frozen=True)
class Expected:
    """Expected results of one controller."""

    outcomes: tuple[str, ...]  # classes of outcomes that are expected; without 'finished' nothing else is compared
    metrics: Mapping[str, Metric]  # metrics by name
    not_compared: Mapping[str, str]  # reasons why metrics are not compared, by name


def expected(
    variants: Sequence[Variant],
    results: Sequence[Measurement],
    period: float,
    metrics: Sequence[run_metrics.Metric] | None = None,
) -> Expected:
    """Return the expectations from the results under every variant, with bands from spreads. Theory: docs/theory-questions.md.

    half-width = max(3 (max_i v_i - min_i v_i), 1e-6 |v|, floor),        v nominal, v_i under the variants of one source, and v
    """
    outcomes = tuple(dict.fromkeys(r.outcome for r in results))
    if outcomes != (FINISHED,):
        return Expected(outcomes, {}, {})
    compared: dict[str, Metric] = {}
    not_compared: dict[str, str] = {}
    names = dict.fromkeys(name for r in results for name in r.numbers)
    for name in names:
        measured = [(v.source, r.numbers[name]) for v, r in zip(variants, results, strict=True) if name in r.numbers]
        if measured[0][0] != NOMINAL:
            not_compared[name] = "only some variants have it"
            continue
        family = metric_of(name, metrics)
        metric = _metric(family, measured, _quantum(family, results[0], period))
        if metric is None:
            not_compared[name] = "some variants have a value and some have none, or words that differ"
        else:
            compared[name] = metric
    broken = {
        f"{name}.*": why for r in results for name, why in r.broken.items()
    }  # no name of a number, which may come
    return Expected(outcomes, compared, {**not_compared, **broken})


def _metric(family: run_metrics.Metric, measured: Sequence[tuple[str, Number]], quantum: float) -> Metric | None:
    values = [value for _, value in measured]
    if any(isinstance(v, str) for v in values):
        return Metric(EXACT, values[0], 0.0, {}) if len(set(values)) == 1 else None
    numbers = [float(v) for v in values]
    finite = [math.isfinite(v) for v in numbers]
    if not any(finite):
        return Metric(EXACT, None, 0.0, {})
    if not all(finite):
        return None
    value, spread = values[0], _spread([(source, float(v)) for source, v in measured])
    largest = FACTOR * max(spread.values(), default=0.0)
    if family.compared == EXACT and largest == 0:
        return Metric(EXACT, value, 0.0, {})
    rounded = {source: float(f"{width:.2g}") for source, width in spread.items()}
    tight = RELATIVE * abs(float(value))
    if family.compared == TIGHT and largest <= tight:
        return Metric(TIGHT, value, _readable(max(tight, family.floor)), rounded)
    return Metric(BANDED, value, _readable(max(largest, tight, family.floor, _QUANTA * quantum)), rounded)


def _readable(band: float) -> float:
    """The band with three digits, rounded up."""
    return float(f"{1.005 * band:.3g}")


def _spread(measured: Sequence[tuple[str, float]]) -> dict[str, float]:
    by_source: dict[str, list[float]] = {}
    for source, value in measured[1:]:
        by_source.setdefault(source, [measured[0][1]]).append(value)
    widths = {source: max(values) - min(values) for source, values in by_source.items()}
    return {source: width for source, width in widths.items() if width}


def _quantum(family: run_metrics.Metric, nominal: Measurement, period: float) -> float:
    """The smallest step of a metric that counts cycles."""
    cycles = nominal.numbers.get("cycles", 0)
    return family.step(period, int(cycles)) if isinstance(cycles, int | float) and cycles >= 1 else 0.0


FOLDER, UNCHECKED = "baselines", "unchecked.toml"


def baseline_path(problem: Path, folder: Path | None = None) -> Path:
    """Return the path of the baseline of a problem file; `folder` replaces the folder `baselines` beside it."""
    return (folder or problem.parent / FOLDER) / f"{problem.stem}.json"


def problems_here(folder: Path, baselines: Path | None = None) -> tuple[list[Path], dict[str, str]]:
    """Return the problem files to check, and the names of those that are left out on purpose, with their reasons.

    The files are those of `folder/problems` and of the folders in it if there is such a folder, else of `folder` itself. A file
    that defines `problem` and `controllers` counts, and every name of a baseline, so that a problem that vanished is noticed.
    """
    place = folder / "problems" if (folder / "problems").is_dir() else folder
    places = [place, *(_inner(place) if place != folder else ())]
    folders = [baselines] if baselines else [p / FOLDER for p in places]
    named: dict[str, Path] = {}
    for path in (f for p in places for f in sorted(p.glob("*.py")) if _is_problem(f)):
        if named.setdefault(path.stem, path) != path:
            raise BaselineError(
                f"'{named[path.stem]}' and '{path}' have one name; rename one, or check them one by one"
            )
    for path in (f for h in folders for f in sorted(h.glob("*.json"))):
        named.setdefault(path.stem, (place if baselines else path.parents[1]) / f"{path.stem}.py")
    listed = {name: reason for h in folders for name, reason in _unchecked(h / UNCHECKED).items()}
    for name in listed:
        if name not in named:
            raise BaselineError(f"{UNCHECKED} names '{name}', which is no problem in '{place}'; take it out")
        if baseline_path(named[name], baselines).exists():
            raise BaselineError(f"{UNCHECKED} names '{name}', which has a baseline; take it out")
    unchecked = {name: why for name, path in named.items() if (why := missing(path))} | listed
    to_check = [path for name, path in sorted(named.items()) if name not in unchecked]
    if not to_check:
        raise BaselineError(f"no problem to check in '{place}'; name one, or go to the folder that has 'problems'")
    return to_check, unchecked


def _inner(place: Path) -> list[Path]:
    """Folders in a folder of problems that hold problems themselves."""
    return [f for f in sorted(place.iterdir()) if f.is_dir() and any(_is_problem(p) for p in f.glob("*.py"))]


def _is_problem(path: Path) -> bool:
    """Whether the file defines problem and controllers, judged without running it; a file with a mistake counts."""
    try:
        body = ast.parse(path.read_text(encoding="utf-8")).body
    except (OSError, SyntaxError, ValueError):
        return True
    inside = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    nodes = [node for s in body if not isinstance(s, inside) for node in ast.walk(s)]
    defined = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    defined |= {n.asname or n.name for n in nodes if isinstance(n, ast.alias)}
    return {"problem", "controllers"} <= defined


def _unchecked(path: Path) -> dict[str, str]:
    try:
        facts = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise BaselineError(f"'{path}' cannot be read: {error}") from None
    for name, reason in facts.items():
        if not isinstance(reason, str) or not reason.strip():
            raise BaselineError(f"'{path}': '{name}' needs a reason in quotes")
    return facts


def check_inside(path: Path, working: Path) -> None:
    """Raise unless `path` lies in the project: the nearest folder above `working` with .git or pyproject.toml, or `working`."""
    working = working.resolve()
    marks = (".git", "pyproject.toml")
    root = next((f for f in (working, *working.parents) if any((f / m).exists() for m in marks)), working)
    if not path.resolve().is_relative_to(root):
        raise OutputError(
            f"'{path}' lies outside of the project '{root}' and is not written; "
            "go to the problem's own project, or give --baselines FOLDER"
        )
    there = next(one for one in path.resolve().parents if one.exists())
    if not there.is_dir():
        raise OutputError(f"cannot write '{path}': '{there}' is a file; give another folder by --baselines")
