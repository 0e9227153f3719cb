"""A search for better settings: every controller has the same number of trials, the same variants and the same cost. By Optuna."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from fpirhc.errors import InvalidProblem, package
from fpirhc.fields.checked import checked_call
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import current_setting, is_whole, with_settings
from fpirhc.studies.comparison.compare import harm_of_adaptation, select
from fpirhc.studies.objective import objective
from fpirhc.studies.variants import Draws, Runner, Variants
from fpirhc.studies.view import Progress
from fpirhc.summary import in_units

FAILED = 10.0  # cost of a run that failed, times up to two


@dataclass(frozen=True, eq=False)
class Tuning:
    """The result of `tune`."""

    problem: str
    table: pd.DataFrame  # a row per setting: controller, setting, before, best, cost_before, cost
    harm: Mapping[str, tuple[str, ...]]  # what speaks against the adaptation with the best settings, by controller

    def settings(self) -> dict[str, dict[str, float]]:
        """Return the best settings by controller and path."""
        return {
            name: dict(zip(some.setting, some.best, strict=True))
            for name, some in self.table.groupby("controller", sort=False)
        }

    def python(self) -> str:
        """Return lines of a problem file that give its controllers the best settings."""
        return "\n".join(
            f"controllers[{n!r}] = fp.with_settings(controllers[{n!r}], {s!r})" for n, s in self.settings().items()
        )


@checked_call
def tune(
    task: Task,
    *,
    trials: int,
    variants: Variants | None = None,
    seed: int = 0,
    controllers: Sequence[str] | None = None,
    metric: str | None = None,
    compiled: bool | None = None,
    folder: Path,
    progress: Progress | None = None,
) -> Tuning:
    """Try settings of every controller with a search space and return the best; trials that `folder` holds are not repeated.

    Raises:
        InvalidProblem: no search space.
        NotInstalled: Optuna.
    """
    optuna: Any = package("optuna", "tune", "tuning")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    if not task.tuning:
        raise InvalidProblem(
            f"problem '{task.name}' has no search space; add tuning = {{NAME: {{'deformation.gain': fp.LogSpan(-2, -0.1)}}}}"
        )
    aim = objective(task.headline_metric if metric is None else metric, task.metrics, task.problem)
    metrics = [m for m in task.metrics if m.name in ("rms_error", aim.metric.name if aim.metric else "")]
    every, rows, harm = list((variants or Draws(1, seed=seed)).of(task)), [], {}
    folder.mkdir(parents=True, exist_ok=True)
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(folder / "trials.log")))
    for name in select(task, controllers) if controllers else task.tuning:
        controller, spans = task.controllers[name], task.tuning[name]
        runner = Runner(task, name, metrics, compiled=compiled)

        def cost(
            trial: Any, controller: Any = controller, spans: Any = spans, runner: Runner = runner, name: str = name
        ) -> float:
            shares = {path: trial.suggest_float(path, 0.0, 1.0) for path in spans}
            own = {p: span.number(shares[p]) for p, span in spans.items()}
            own = {p: round(v) if is_whole(controller, p) else v for p, v in own.items()}
            if progress:
                progress(name, trial.number + 1, trials)
            return mean_cost(runner.records([replace(v, settings=own) for v in every]), aim)

        sampler = optuna.samplers.TPESampler(seed=seed)
        search = optuna.create_study(
            storage=storage, study_name=f"{name} {variants!r} {aim.name} {seed}", load_if_exists=True, sampler=sampler
        )
        search.optimize(cost, n_trials=max(0, trials - len(search.trials)))
        now = {path: current_setting(controller, path) for path in spans}
        before = mean_cost(runner.records([replace(v, settings=now) for v in every]), aim)
        found = (
            {p: span.number(search.best_params[p]) for p, span in spans.items()} if search.best_value < before else now
        )
        found = {p: round(v) if is_whole(controller, p) else v for p, v in found.items()}
        costs = {"cost_before": before, "cost": min(before, search.best_value)}
        rows += [{"controller": name, "setting": p, "before": now[p], "best": v, **costs} for p, v in found.items()]
        harm[name] = harm_of_adaptation(
            task.problem, name, with_settings(controller, found), seed=seed, compiled=bool(compiled)
        )
    return Tuning(task.name, in_units(pd.DataFrame(rows), {}), harm)


def mean_cost(rows: Any, aim: Any) -> float:
    """Return the mean cost of runs: the relative error or the metric, smaller is better; one that failed costs `FAILED`."""
    column, sign = ("error", 1) if aim.metric is None else (aim.name, -1 if aim.better == "larger" else 1)
    costs = [sign * r[column] if r["outcome"] == "finished" else FAILED if aim.metric is None else 1e12 for r in rows]
    return sum(costs) / len(costs)
