"""A search for better settings: every controller has the same number of trials, the same variants and the same cost. By Optuna."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fpirhc.controllers.base import Controller
from fpirhc.describe import digest
from fpirhc.errors import InvalidProblem, InvalidValue, package
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import TuningSpans, current_setting
from fpirhc.studies import Progress
from fpirhc.studies.compare import check_gains, select
from fpirhc.studies.runs import Runner
from fpirhc.studies.variants import Draws, Variant, Variants
from fpirhc.studies.verdict import Objective, objective
from fpirhc.task.cases import is_whole

_STARTS = 10  # first trials, which are random


@dataclass(frozen=True, eq=False)
class Tuning:
    """The result of `tune`.

    Args:
        problem: its name.
        table: a row per setting: controller, setting, before, best, cost_before, cost, trials.
    """

    problem: str
    table: pd.DataFrame

    def settings(self) -> dict[str, dict[str, float]]:
        """Return the best settings by controller and path."""
        return {
            str(name): dict(zip(some.setting, some.best, strict=True))
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
    seed: Seed = 0,
    controllers: Sequence[str] | None = None,
    metric: str | None = None,
    compiled: bool | None = None,
    folder: Path,
    progress: Progress | None = None,
) -> Tuning:
    """Try settings of every controller with a search space and return the best; trials that `folder` holds are not repeated.

    The cost is the mean over the variants: of the relative error, or of a metric, the negative one where larger is better; a run
    that failed costs 10 to 20 times the range of the reference. The settings as they are count too, so the best is never worse.
    A search that is interrupted goes on to the same end.

    Args:
        trials: of every controller.
        variants: that all trials share; None: the problem itself with the noise of `seed`.
        controllers: names; None: those with a search space.
        metric: a number of a run; None: the problem's `headline_metric`, or the relative error.
        compiled: whether loops run as compiled C; None: where runs are long.
        folder: of the trials.
        progress: called with (controller, trials done, in all).

    Raises:
        InvalidProblem: no search space.
        InvalidValue: no trial, or a metric that cannot be judged.
        NotInstalled: Optuna.
    """
    optuna: Any = package("optuna", "tune", "tuning")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    if trials < 1:
        raise InvalidValue(f"trials {trials}: expected at least 1")
    chosen = select(task, controllers) if controllers or not task.tuning else select(task, [*task.tuning])
    if lacking := [name for name in chosen if not task.tuning.get(name)]:
        raise InvalidProblem(
            f"problem '{task.name}': no search space for controller {', '.join(map(repr, lacking))}; add to its file, for example, "
            f"tuning = {{{lacking[0]!r}: {{'deformation.gain': fpirhc.LogSpan(-2.0, -0.1)}}}}"
        )
    check_gains(task, chosen)
    aim = objective(task.headline_metric if metric is None else metric, task.metrics, task.problem)
    variants = variants or Draws(1, seed=seed)
    every, rows = list(variants.of(task)), list[dict[str, Any]]()
    metrics = [m for m in task.metrics if m.name == "rms_error" or m is aim.metric]
    folder.mkdir(parents=True, exist_ok=True)
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(folder / "trials.log")))
    for name, controller in chosen.items():
        runner = Runner(task, name, metrics, compiled=compiled)
        search = _Search(controller, task.tuning[name], runner, every, aim)
        what = digest(task.problem, controller, task.tuning[name]), f"{variants!r}", aim.column, seed
        study = optuna.create_study(storage=storage, study_name=f"{name} {what}", load_if_exists=True)
        for number in range(len(_finished(study)), trials):
            # A sampler for every trial: where the search was interrupted is then no part of it.
            own_seed = int(np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0])
            study.sampler = optuna.samplers.TPESampler(seed=own_seed, n_startup_trials=_STARTS)
            study.optimize(search, n_trials=1)
            if progress:
                progress(name, number + 1, trials)
        done = _finished(study)[:trials]
        best = min(done, key=lambda trial: trial.value)
        now = {path: current_setting(controller, path) for path in search.spans}
        before = search.cost(now)
        found = search.numbers(best.params) if best.value < before else now
        facts = {"cost_before": before, "cost": min(before, best.value), "trials": len(done)}
        rows += [{"controller": name, "setting": p, "before": now[p], "best": v, **facts} for p, v in found.items()]
    table = pd.DataFrame(rows)
    for column in ("before", "best"):  # a whole number stays one beside others: a setting takes no 2.0 for it
        table[column] = pd.Series([row[column] for row in rows], dtype=object)
    return Tuning(task.name, table)


def _finished(study: Any) -> list[Any]:
    """The trials that are finished; one that was interrupted is none, and the sampler must not count it."""
    trials = study.get_trials(deepcopy=False)
    for trial in trials:
        if trial.state.name == "RUNNING":
            study.tell(trial.number, state=type(trial.state).FAIL)
    return [trial for trial in trials if trial.state.name == "COMPLETE"]


@dataclass(frozen=True, eq=False)
class _Search:
    """The cost of a trial of one controller."""

    controller: Controller
    spans: TuningSpans
    runner: Runner
    variants: Sequence[Variant]
    aim: Objective

    def __call__(self, trial: Any) -> float:
        return self.cost(self.numbers({path: trial.suggest_float(path, 0.0, 1.0) for path in self.spans}))

    def numbers(self, shares: Mapping[str, float]) -> dict[str, float]:
        """The settings at these shares of their spans."""
        own = {path: span.number(shares[path]) for path, span in self.spans.items()}
        return {path: round(v) if is_whole(self.controller, path) else v for path, v in own.items()}

    def cost(self, own: Mapping[str, float]) -> float:
        """The mean cost of settings over the variants."""
        costs = [self.aim.cost(row) for row in self.runner.rows(replace(one, settings=own) for one in self.variants)]
        return sum(costs) / len(costs)
