"""`check` compares a problem with its baseline; `accept` measures a new one and writes it.

A baseline that is truncated, edited by hand, newer or incomplete is refused when it is read.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from fpirhc.baselines.baseline import (
    BANDED,
    EXACT,
    FORMAT,
    KINDS,
    Baseline,
    Expected,
    Metric,
    Settings,
    baseline_path,
    check_inside,
    differences,
    expected,
    fingerprint,
    settings_hash,
    settings_of,
    to_text,
)
from fpirhc.baselines.judging import Judgement, judge
from fpirhc.baselines.measuring import (
    FINISHED,
    REFUSED,
    SEEDS,
    SOURCES,
    Job,
    measure_all,
    metric_of,
    names_by_source,
    nominal,
    variants,
)
from fpirhc.errors import BaselineError, FpirhcError, InvalidName, InvalidValue, OutputError
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Few, Range, Seed
from fpirhc.problem_files.problem_file import Task, load_problem
from fpirhc.simulation import metrics as run_metrics
from fpirhc.studies.comparison.compare import select
from fpirhc.studies.view import Progress, versions
from fpirhc.whole_file import write_whole

_SEEDS = 8  # of bands, where there is noise
_LARGEST = 20_000_000  # bytes; a baseline has some tens of thousands


def read_baseline(path: Path, metrics: Sequence[run_metrics.Metric] | None = None) -> Baseline:
    """Return the baseline in a file.

    Args:
        path: path of the file.
        metrics: metrics of the problem's runs; None: names are not checked.

    Raises:
        BaselineError: the file is missing, damaged, edited by hand, of a newer format, of another problem, or compares
            nothing.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise BaselineError(f"'{path.name}' is larger than {_LARGEST / 1e6:.0f} MB and no baseline; {_ACCEPT}")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise BaselineError(
            f"there is no baseline '{path.name}'; write one: fpirhc accept PROBLEM --reason ..."
        ) from None
    except OSError as error:
        raise BaselineError(f"'{path.name}' cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise BaselineError(f"'{path.name}' is no text ({error.reason}); restore it, or {_ACCEPT}") from None
    return read_text(text, path, metrics)


def read_text(text: str, path: Path, metrics: Sequence[run_metrics.Metric] | None = None) -> Baseline:
    """Return the baseline in a text that is, or will be, in the file at `path`.

    Raises:
        BaselineError: see `read_baseline`.
    """
    facts = _parsed(text, path)
    file_format = facts.get("format")
    if isinstance(file_format, int) and not isinstance(file_format, bool) and file_format > FORMAT:
        raise BaselineError(
            f"'{path.name}' has format {file_format}, this version reads {FORMAT}: it was written by a newer fpirhc; upgrade"
        )
    checksum = facts.pop("checksum", None)
    if file_format != FORMAT or checksum is None:
        raise BaselineError(f"'{path.name}' is not a baseline of format {FORMAT}; {_ACCEPT}")
    if checksum != fingerprint(facts):
        raise BaselineError(f"'{path.name}' was edited by hand, its checksum does not fit; restore it, or {_ACCEPT}")
    try:
        baseline = _baseline(facts)
        for key in {key for one in baseline.controllers.values() for key in one.metrics} if metrics is not None else ():
            metric_of(key, metrics)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        reason = error if isinstance(error, BaselineError | InvalidName) else f"it lacks or misshapes {error}"
        raise BaselineError(f"'{path.name}': {reason}; {_ACCEPT}") from None
    if baseline.problem != path.stem:
        raise BaselineError(f"'{path.name}' is the baseline of '{baseline.problem}', not of '{path.stem}'; {_ACCEPT}")
    return baseline


_ACCEPT = "measure it again with: fpirhc accept PROBLEM --reason ..."


def _parsed(text: str, path: Path) -> dict[str, Any]:
    try:
        facts = json.loads(text, object_pairs_hook=_without_doubles, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise BaselineError(f"'{path.name}' is no complete JSON ({error}); restore it, or {_ACCEPT}") from None
    if not isinstance(facts, dict):
        raise BaselineError(f"'{path.name}' is no baseline: expected an object, got {type(facts).__name__}; {_ACCEPT}")
    return facts


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) != len(pairs):
        raise ValueError("a key stands in it twice")
    return entries


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number")


def _baseline(facts: dict[str, Any]) -> Baseline:
    settings = Settings(
        dict(facts["settings"]["problem"]), {k: dict(v) for k, v in facts["settings"]["controllers"].items()}
    )
    if facts["settings"]["hash"] != settings_hash(settings):
        raise BaselineError("the hash of its settings does not fit them")
    controllers = {name: _expected(name, one) for name, one in facts["controllers"].items()}
    if not controllers:
        raise BaselineError("it holds no controller and would compare nothing")
    if set(controllers) != set(settings.controllers):
        raise BaselineError("its controllers and their settings differ")
    for name in ("problem", "reason", "date"):
        if not isinstance(facts[name], str) or not facts[name].strip():
            raise BaselineError(f"it has no {name}")
    if not isinstance(facts["seed"], int) or facts["seed"] < 0:
        raise BaselineError("its seed is no whole number of at least 0")
    return Baseline(
        facts["problem"],
        facts["reason"],
        facts["date"],
        facts["seed"],
        {str(k): str(v) for k, v in facts["versions"].items()},
        {str(k): [str(n) for n in v] for k, v in facts["varied"].items()},
        settings,
        controllers,
    )


def _expected(name: str, facts: dict[str, Any]) -> Expected:
    outcomes = tuple(str(o) for o in facts["outcomes"])
    metrics = {metric: _metric(f"{name}: {metric}", one) for metric, one in facts["metrics"].items()}
    skipped = {str(k): str(v) for k, v in facts["not_compared"].items()}
    if not outcomes:
        raise BaselineError(f"controller '{name}' has no outcome")
    if outcomes == (FINISHED,) and not any(m.kind == BANDED for m in metrics.values()):
        raise BaselineError(f"controller '{name}' has no metric with a band")
    return Expected(outcomes, metrics, skipped)


def _metric(where: str, facts: dict[str, Any]) -> Metric:
    kind, value = facts["kind"], facts["value"]
    if kind not in KINDS:
        raise BaselineError(f"{where} has class '{kind}'; expected one of {', '.join(KINDS)}")
    if not (value is None or isinstance(value, str) or _is_number(value)):
        raise BaselineError(f"{where} has the value {str(value)[:40]!r}; expected a finite number, a word or null")
    if kind == EXACT:
        return Metric(kind, value, 0.0, {})
    if not _is_number(value):
        raise BaselineError(f"{where} is {kind} and has no number")
    band, spread = facts.get("band"), facts.get("spread")
    if not isinstance(band, int | float) or not _is_number(band) or band <= 0:
        raise BaselineError(f"{where} is {kind} and has no band")
    if not isinstance(spread, dict) or not all(s in SOURCES and _is_number(v) for s, v in spread.items()):
        raise BaselineError(f"{where} has no spread by {', '.join(SOURCES)}")
    return Metric(kind, value, float(band), spread)


def _is_number(value: Any) -> bool:
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False


@checked_call
def check_baseline(
    task: Task,
    *,
    controllers: Sequence[str] | None = None,
    baselines: Path | None = None,
    compiled: bool = True,
    processes: Few = 1,
    progress: Progress | None = None,
) -> Judgement:
    """Measure a problem's controllers and compare them with its baseline; nothing is written.

    Args:
        task: the loaded problem file.
        controllers: names of controllers; None: all.
        baselines: folder of the baselines; None: the one beside the problem file.
        compiled: whether runs use compiled C.
        processes: number of processes, each of which loads the problem file anew.
        progress: function of (problem, runs done, runs in all) that is called after every run.

    Raises:
        InvalidProblem: unknown controllers.
    """
    names = list(select(task, controllers))
    try:
        baseline = read_baseline(baseline_path(task.path, baselines), task.metrics)
    except BaselineError as error:
        return Judgement(task.name, unusable=(str(error),))
    jobs = [Job(name, nominal(baseline.seed, compiled)) for name in names]
    results = measure_all(task, jobs, processes=processes, progress=progress)
    judgement = judge(baseline, settings_of(task), dict(zip(names, results, strict=True)), task.metrics)
    judgement = replace(judgement, headline=task.headline_metric or "")
    return judgement if judgement.holds else replace(judgement, notes=(*judgement.notes, *_other_versions(baseline)))


def _other_versions(baseline: Baseline) -> list[str]:
    """Versions with which the baseline was measured, where they differ from those of now."""
    now = versions()
    other = [f"{name} {was} (now {now.get(name)})" for name, was in baseline.versions.items() if now.get(name) != was]
    return [f"the baseline was measured with {', '.join(other)}"] if other else []


def check_file(
    path: str,
    *,
    baselines: Path | None = None,
    compiled: bool = True,
    processes: Few = 1,
    progress: Progress | None = None,
) -> Judgement:
    """Return the judgement of a problem by name or path; a problem that cannot be loaded is `broken`."""
    try:
        task = load_problem(path)
    except FpirhcError as error:
        return Judgement(Path(path).stem or path, broken=str(error))
    return check_baseline(task, baselines=baselines, compiled=compiled, processes=processes, progress=progress)


def measure_expected(
    task: Task,
    controllers: Sequence[str],
    *,
    seed: Seed = 0,
    seeds: int = _SEEDS,
    compiled: bool = True,
    processes: Few = 1,
    progress: Progress | None = None,
) -> dict[str, Expected]:
    """Run controllers under every variant and return the expectations of their baseline."""
    all_variants = variants(task.problem, seed=seed, seeds=seeds, compiled=compiled)
    jobs = [Job(name, variant) for name in controllers for variant in all_variants]
    results = measure_all(task, jobs, processes=processes, progress=progress)
    expectations, count = {}, len(all_variants)
    for k, name in enumerate(controllers):
        expectations[name] = expected(
            all_variants, results[k * count : (k + 1) * count], task.problem.period, task.metrics
        )
    return expectations


def compose_baseline(
    task: Task,
    expectations: Mapping[str, Expected],
    reason: str,
    *,
    seed: Seed = 0,
    seeds: int = _SEEDS,
    compiled: bool = True,
) -> Baseline:
    """Return the baseline of the controllers that were measured."""
    if all(outcome.startswith(REFUSED) for one in expectations.values() for outcome in one.outcomes):
        raise BaselineError(
            f"no controller of '{task.name}' can run, so a baseline would hold nothing: see fpirhc compare"
        )
    varied = names_by_source(variants(task.problem, seed=seed, seeds=seeds, compiled=compiled))
    settings = settings_of(task)
    return Baseline(
        problem=task.name,
        reason=require_reason(reason),
        date=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        seed=seed,
        versions=versions(),
        varied=varied,
        settings=settings.without(set(settings.controllers) - set(expectations)),
        controllers=dict(expectations),
    )


def require_reason(reason: str) -> str:
    """Return the reason on one line."""
    line = " ".join(reason.split())
    if not line:
        raise InvalidValue("a baseline needs a reason: say why the new numbers are right, --reason 'horizon 20 -> 30'")
    return line


def write_baseline(task: Task, baseline: Baseline, baselines: Path | None, working: Path) -> Path:
    """Write a baseline and return its path."""
    path = baseline_path(task.path, baselines)
    check_inside(path, working)
    _write(baseline, path)
    return path


def _write(baseline: Baseline, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write the baseline to '{path}': {error.strerror}") from None
    write_whole(to_text(baseline), path, "baseline")


@checked_call
def accept(
    task: Task,
    reason: str,
    *,
    seed: Seed | None = None,
    seeds: Annotated[int, Range("a whole number of at least 2 (8 is usual)", low=2)] | None = None,
    baselines: Path | None = None,
    compiled: bool = True,
    processes: Few = 1,
    working: Path | None = None,
    progress: Progress | None = None,
) -> tuple[Baseline, Path]:
    """Measure every controller under all variants, write the baseline, and return it with its path.

    Args:
        seed: of the run that is compared; None: that of the earlier baseline, 0 without one.
        seeds: number of seeds for the bands; None: as many as before, 8 without a baseline.
        baselines: folder of the baselines; None: the one beside the problem file.
        working: a folder of the project, outside of which nothing is written; None: the current folder.
        progress: function of (problem, runs done, runs in all) that is called after every run.

    Raises:
        InvalidValue: no reason, or too few seeds.
        BaselineError: the baseline would compare nothing.
        OutputError: the file cannot be written, or lies outside of the project.
    """
    require_reason(reason)
    project = working or Path.cwd()
    check_inside(baseline_path(task.path, baselines), project)
    before = seeds_of(task, baselines)
    seed, seeds = (usual if given is None else given for given, usual in zip((seed, seeds), before, strict=True))
    expectations = measure_expected(
        task, list(task.controllers), seed=seed, seeds=seeds, compiled=compiled, processes=processes, progress=progress
    )
    baseline = compose_baseline(task, expectations, reason, seed=seed, seeds=seeds, compiled=compiled)
    return baseline, write_baseline(task, baseline, baselines, project)


def seeds_of(task: Task, baselines: Path | None = None) -> tuple[int, int]:
    """Return seed and number of seeds of the baseline of a problem file; without one, those of a new baseline."""
    try:
        earlier = read_baseline(baseline_path(task.path, baselines))
    except BaselineError:
        return 0, _SEEDS
    drawn = len(earlier.varied.get(SEEDS, ()))
    return earlier.seed, drawn + 1 if drawn else _SEEDS


def write_merged(task: Task, parts: Sequence[str], working: Path) -> Path:
    """Write the baseline of all parts, with those of the task's controllers in the earlier file that no part has.

    `working`: a folder of the project, outside of which nothing is written.
    """
    path = baseline_path(task.path)
    check_inside(path, working)
    merged = read_text(parts[0], path)
    for text in parts[1:]:
        merged = _joined(merged, read_text(text, path))
    if path.exists():
        earlier = _without(read_baseline(path), task.controllers)
        _check_mergeable(earlier, settings_of(task), merged)
        merged = _joined(earlier, merged)
    _write(merged, path)
    return path


def _without(baseline: Baseline, controllers: Collection[str]) -> Baseline:
    """The baseline without controllers that the problem file no longer has."""
    gone = set(baseline.controllers) - set(controllers)
    left = {name: one for name, one in baseline.controllers.items() if name not in gone}
    return replace(baseline, settings=baseline.settings.without(gone), controllers=left)


def _check_mergeable(before: Baseline, now: Settings, merged: Baseline) -> None:
    """Raise if controllers of the earlier baseline were not measured, although problem or seed changed."""
    others = [name for name in before.controllers if name not in merged.controllers]
    changed = differences("", before.settings.problem, now.problem, names=False)
    if others and (changed or before.seed != merged.seed):
        raise BaselineError(
            f"problem '{before.problem}' changed, and {', '.join(others)} were not measured; its baseline is left as it "
            "is: run the tests of all its controllers, or fpirhc accept"
        )


def _joined(first: Baseline, second: Baseline) -> Baseline:
    """The second baseline with those controllers of the first that it lacks."""
    settings = Settings(second.settings.problem, {**first.settings.controllers, **second.settings.controllers})
    return replace(second, settings=settings, controllers={**first.controllers, **second.controllers})
