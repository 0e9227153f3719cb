"""`check` compares a problem with its baseline; `accept` measures a new one and writes it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fpirhc.baselines.bands import Expected, expected
from fpirhc.baselines.baseline import Baseline, to_text
from fpirhc.baselines.judging import Judgement, judge
from fpirhc.baselines.measuring import REFUSED, Job, Progress, measure_all
from fpirhc.baselines.places import baseline_path, check_inside, write_whole
from fpirhc.baselines.reading import read_baseline
from fpirhc.baselines.settings import settings_of
from fpirhc.baselines.variants import names_by_source, nominal, variants
from fpirhc.errors import BaselineError, FpirhcError, InvalidValue
from fpirhc.problem_files.problem_file import Task, load_problem
from fpirhc.studies.comparison.compare import select, versions


def check_baseline(
    task: Task,
    *,
    controllers: Sequence[str] | None = None,
    baselines: Path | None = None,
    compiled: bool = True,
    processes: int = 1,
    progress: Progress | None = None,
) -> Judgement:
    """Measure a problem's controllers and compare them with its baseline; nothing is written.

    Parameters: `controllers` to compare, all when not given; `baselines` folder instead of the one beside the problem file;
    `processes` at once, each of which loads the problem file anew.

    Raises:
        InvalidProblem: unknown controllers.
    """
    chosen = list(select(task, controllers))
    try:
        baseline = read_baseline(baseline_path(task.path, baselines), task.metrics)
    except BaselineError as error:
        return Judgement(task.name, unusable=(str(error),))
    jobs = [Job(name, nominal(baseline.seed, compiled)) for name in chosen]
    results = measure_all(task, jobs, processes=processes, progress=progress)
    judgement = judge(baseline, settings_of(task), dict(zip(chosen, results, strict=True)), task.metrics)
    return judgement if judgement.holds else replace(judgement, notes=(*judgement.notes, *_other_versions(baseline)))


def _other_versions(baseline: Baseline) -> list[str]:
    """What the baseline was measured with, where that is something else now."""
    now = versions()
    other = [f"{name} {was} (now {now.get(name)})" for name, was in baseline.versions.items() if now.get(name) != was]
    return [f"the baseline was measured with {', '.join(other)}"] if other else []


def check_file(
    path: str,
    *,
    baselines: Path | None = None,
    compiled: bool = True,
    processes: int = 1,
    progress: Progress | None = None,
) -> Judgement:
    """Return what becomes of a problem by name or path; one that cannot be loaded has that as its judgement."""
    try:
        task = load_problem(path)
    except FpirhcError as error:
        return Judgement(Path(path).stem, broken=str(error))
    return check_baseline(task, baselines=baselines, compiled=compiled, processes=processes, progress=progress)


def measure_expected(
    task: Task,
    controllers: Sequence[str],
    *,
    seed: int = 0,
    seeds: int = 8,
    compiled: bool = True,
    processes: int = 1,
    progress: Progress | None = None,
) -> dict[str, Expected]:
    """Run controllers under every variant and return what a baseline expects of them from now on."""
    chosen = variants(task.problem, seed=seed, seeds=seeds, compiled=compiled)
    jobs = [Job(name, variant) for name in controllers for variant in chosen]
    results = measure_all(task, jobs, processes=processes, progress=progress)
    found, count = {}, len(chosen)
    for k, name in enumerate(controllers):
        found[name] = expected(chosen, results[k * count : (k + 1) * count], task.problem.period, task.metrics)
    return found


def compose_baseline(
    task: Task, found: Mapping[str, Expected], reason: str, *, seed: int = 0, seeds: int = 8, compiled: bool = True
) -> Baseline:
    """Return the baseline of what was measured; controllers that were not are left out.

    Raises:
        BaselineError: it would compare nothing.
    """
    if all(outcome.startswith(REFUSED) for one in found.values() for outcome in one.outcomes):
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
        settings=settings.without(set(settings.controllers) - set(found)),
        controllers=dict(found),
    )


def require_reason(reason: str) -> str:
    """Return the reason on one line.

    Raises:
        InvalidValue: there is none.
    """
    line = " ".join(reason.split())
    if not line:
        raise InvalidValue("a baseline needs a reason: say why the new numbers are right, --reason 'horizon 20 -> 30'")
    return line


def write_baseline(task: Task, baseline: Baseline, baselines: Path | None, working: Path) -> Path:
    """Write a baseline and return where.

    Raises:
        OutputError: the place is outside of the project that `working` is in, or cannot be written.
    """
    path = baseline_path(task.path, baselines)
    check_inside(path, working)
    write_whole(to_text(baseline), path, "baseline")
    return path


def accept(
    task: Task,
    reason: str,
    *,
    seed: int = 0,
    seeds: int = 8,
    baselines: Path | None = None,
    compiled: bool = True,
    processes: int = 1,
    working: Path | None = None,
    progress: Progress | None = None,
) -> tuple[Baseline, Path]:
    """Measure every controller under all variants, write the baseline, and return it and where it is.

    Parameters: `reason` why the new numbers are right; `seed` of the nominal run and how many `seeds` the bands are made of;
    `working` a folder of the project that may be written to, the current one when not given.

    Raises:
        InvalidValue: no reason. BaselineError: it would hold nothing. OutputError: it cannot be written there.
    """
    require_reason(reason)
    if seeds < 2 or seed < 0:
        raise InvalidValue(f"seed {seed} with {seeds} seeds: expected at least 0 and at least 2; 8 seeds are usual")
    project = working or Path.cwd()
    check_inside(baseline_path(task.path, baselines), project)
    found = measure_expected(
        task, list(task.controllers), seed=seed, seeds=seeds, compiled=compiled, processes=processes, progress=progress
    )
    baseline = compose_baseline(task, found, reason, seed=seed, seeds=seeds, compiled=compiled)
    return baseline, write_baseline(task, baseline, baselines, project)


def bless(task: Task, reason: str, **settings: Any) -> tuple[Baseline, Path]:
    """Return what `accept` returns: the earlier name, which goes with the next version."""
    warnings.warn("fpirhc.bless is now fpirhc.accept", DeprecationWarning, stacklevel=2)
    return accept(task, reason, **settings)
