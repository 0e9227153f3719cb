"""`check` compares a problem with its baseline; `accept` measures a new one and writes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from fpirhc.baselines.bands import Expected, expected
from fpirhc.baselines.baseline import Baseline, Settings, fingerprint, settings_of, to_text
from fpirhc.baselines.judging import Judgement, judge
from fpirhc.baselines.measuring import REFUSED, Job, measure_all, names_by_source, nominal, variants
from fpirhc.baselines.places import baseline_path, check_inside
from fpirhc.baselines.reading import read_baseline, read_text
from fpirhc.errors import BaselineError, FpirhcError, InvalidValue, OutputError
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.problem_files.problem_file import Task, load_problem
from fpirhc.studies.comparison.compare import select
from fpirhc.studies.view import Progress, versions
from fpirhc.whole_file import write_whole


@checked_call
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
    processes: int = 1,
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
    seeds: int = 8,
    compiled: bool = True,
    processes: int = 1,
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
    seeds: int = 8,
    compiled: bool = True,
) -> Baseline:
    """Return the baseline of the controllers that were measured.

    Args:
        task: the loaded problem file.
        expectations: expectations by controller.
        reason: why the new numbers are right.
        seed: seed of the nominal run.
        seeds: number of seeds for the bands.
        compiled: whether runs use compiled C.

    Raises:
        BaselineError: the baseline would compare nothing.
    """
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
    """Return the reason on one line.

    Raises:
        InvalidValue: the reason is empty.
    """
    line = " ".join(reason.split())
    if not line:
        raise InvalidValue("a baseline needs a reason: say why the new numbers are right, --reason 'horizon 20 -> 30'")
    return line


def write_baseline(task: Task, baseline: Baseline, baselines: Path | None, working: Path) -> Path:
    """Write a baseline and return its path.

    Raises:
        OutputError: the path is outside of the project of `working`, or cannot be written.
    """
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
    seed: Seed = 0,
    seeds: int = 8,
    baselines: Path | None = None,
    compiled: bool = True,
    processes: int = 1,
    working: Path | None = None,
    progress: Progress | None = None,
) -> tuple[Baseline, Path]:
    """Measure every controller under all variants, write the baseline, and return it with its path.

    Args:
        task: the loaded problem file.
        reason: why the new numbers are right.
        seed: seed of the nominal run.
        seeds: number of seeds for the bands.
        baselines: folder of the baselines; None: the one beside the problem file.
        compiled: whether runs use compiled C.
        processes: number of processes.
        working: a folder of the project, outside of which nothing is written; None: the current folder.
        progress: function of (problem, runs done, runs in all) that is called after every run.

    Raises:
        InvalidValue: no reason, or too few seeds.
        BaselineError: the baseline would compare nothing.
        OutputError: the file cannot be written, or lies outside of the project.
    """
    require_reason(reason)
    if seeds < 2 or seed < 0:
        raise InvalidValue(
            f"accept: expected a seed of at least 0 and at least 2 seeds, got seed={seed} and seeds={seeds}; 8 seeds are usual"
        )
    project = working or Path.cwd()
    check_inside(baseline_path(task.path, baselines), project)
    expectations = measure_expected(
        task, list(task.controllers), seed=seed, seeds=seeds, compiled=compiled, processes=processes, progress=progress
    )
    baseline = compose_baseline(task, expectations, reason, seed=seed, seeds=seeds, compiled=compiled)
    return baseline, write_baseline(task, baseline, baselines, project)


def write_merged(problem: Path, parts: Sequence[str], working: Path) -> Path:
    """Write the baseline of all parts, with those controllers of the earlier file that no part has.

    Args:
        problem: path of the problem file.
        parts: texts of baselines.
        working: a folder of the project, outside of which nothing is written.

    Raises:
        BaselineError: the problem's settings changed, and the file has controllers that were not measured.
        OutputError: the file cannot be written.
    """
    path = baseline_path(problem)
    check_inside(path, working)
    merged = read_text(parts[0], path)
    for text in parts[1:]:
        merged = _joined(merged, read_text(text, path))
    if path.exists():
        earlier = read_baseline(path)
        _check_mergeable(earlier, merged)
        merged = _joined(earlier, merged)
    _write(merged, path)
    return path


def _check_mergeable(before: Baseline, merged: Baseline) -> None:
    """Raise if controllers of the earlier baseline were not measured, although problem or seed changed."""
    others = [name for name in before.controllers if name not in merged.controllers]
    if others and (
        fingerprint(before.settings.problem) != fingerprint(merged.settings.problem) or before.seed != merged.seed
    ):
        raise BaselineError(
            f"problem '{before.problem}' changed, and {', '.join(others)} were not measured; its baseline is left as it "
            "is: run the tests of all its controllers, or fpirhc accept"
        )


def _joined(first: Baseline, second: Baseline) -> Baseline:
    """The second baseline with those controllers of the first that it lacks."""
    settings = Settings(second.settings.problem, {**first.settings.controllers, **second.settings.controllers})
    return replace(second, settings=settings, controllers={**first.controllers, **second.controllers})
