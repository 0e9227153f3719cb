"""A search for better settings: every controller has the same number of trials, the same scenarios and the same cost.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from fpirhc.describe import describe
from fpirhc.errors import InvalidProblem, InvalidValue, package
from fpirhc.fields.checked import Checked, FoundByName, checked_call
from fpirhc.fields.kinds import CountOrZero, Seed
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import TuningSpans, current_setting, is_whole, unit_of_setting, with_settings
from fpirhc.review.grid import is_late
from fpirhc.studies.comparison.compare import select
from fpirhc.studies.comparison.pairwise import harm_of_adaptation
from fpirhc.studies.objective import Objective, objective
from fpirhc.studies.scenarios.bench import SIDE_BY_SIDE, Conditions, Trials, is_of_judgements, scenario_numbers
from fpirhc.studies.scenarios.draws import TUNING
from fpirhc.studies.scenarios.fingerprint import fingerprint
from fpirhc.studies.scenarios.ledger import Ledger, begun_with
from fpirhc.studies.tuned_file import as_python
from fpirhc.studies.view import Progress
from fpirhc.summary import in_units
from fpirhc.symbolic.paths import content_at, paths_to

if TYPE_CHECKING:
    import pandas as pd

LEDGER = "trials.jsonl"
_MOST = 1_000_000  # trials, all of which a proposal follows from
_REGISTER = 8  # runs of a generation from which they are side by side
_PRESENT = -1  # number of the trial of the settings as they are, which no budget counts


@dataclass(frozen=True, eq=False)
class TunedController(FoundByName):
    """One controller's settings before and after tuning, with their costs."""

    name: str  # name of the controller
    before: Mapping[str, float]  # settings of the problem file, by path
    settings: Mapping[str, float]  # the best settings, by path
    cost_before: float  # cost of the settings before
    cost: float  # cost of the best settings
    failed: int  # number of trials with a failure in some scenario
    # what speaks against its adaptation with the best settings, in the run of the problem file; see `harm_of_adaptation`
    harm: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Tuning(FoundByName):
    """The result of `tune`.

    Args:
        problem: name of the problem.
        trials: number of trials of every controller.
        seed: of the proposals and of the scenarios.
        conditions: the scenarios in words.
        metric: name of the number that is the cost.
        entries: the tuned controllers.
        untouched: names of controllers without a search space.
        units: units of the settings, by path, and of the number that is the cost, as far as they have one.
    """

    problem: str
    trials: int
    seed: int
    conditions: str
    metric: str
    entries: tuple[TunedController, ...]
    untouched: tuple[str, ...]
    units: Mapping[str, str]

    def python(self) -> str:
        """Lines of a problem file that give its controllers the best settings."""
        notes = {e.name: f"cost {e.cost_before:.4g} before, {e.cost:.4g} after" for e in self.entries}
        return as_python({e.name: e.settings for e in self.entries}, notes)

    def to_dataframe(self) -> pd.DataFrame:
        """Return a row per setting: `controller`, `setting`, `unit`, `before`, `best`, and `cost_before`, `cost` of the controller.

        `attrs["units"]` has the unit of the costs.
        """
        import pandas as pd

        frame = pd.DataFrame(
            {"controller": e.name, "setting": path, "unit": self.units.get(path, "")}
            | {"before": e.before[path], "best": best, "cost_before": e.cost_before, "cost": e.cost}
            for e in self.entries
            for path, best in e.settings.items()
        )
        return in_units(frame, dict.fromkeys(("cost_before", "cost"), self.units.get(self.metric, "")))

    def facts(self) -> dict[str, Any]:
        """Plain data for a file."""
        controllers = {
            e.name: {
                "settings": dict(e.settings),
                "before": dict(e.before),
                "cost": e.cost,
                "cost_before": e.cost_before,
                "failed_trials": e.failed,
                "harm": list(e.harm),
            }
            for e in self.entries
        }
        return {
            "problem": self.problem,
            "trials": self.trials,
            "seed": self.seed,
            "conditions": self.conditions,
            "metric": self.metric,
            "controllers": controllers,
            "untouched": list(self.untouched),
        }


@checked_call
def tune(
    task: Task,
    *,
    trials: int,
    seed: Seed,
    folder: Path,
    controllers: Sequence[str] | None = None,
    count: int = 1,
    percent: float = 0.0,
    cases: Sequence[str] | None = None,
    metric: str | None = None,
    compiled: bool | None = None,
    population: int = 1,
    progress: Progress | None = None,
) -> Tuning:
    """Try settings of every controller with a search space and return the best; trials that `folder` holds are not repeated.

    Args:
        task: the loaded problem file.
        trials: number of trials of every controller.
        seed: of the proposals and of the scenarios.
        folder: folder to which finished trials are written, one by one.
        controllers: names of controllers; None: all that the task's tuning has.
        count: number of scenarios in a trial.
        percent: range of the exact parameters' draws, percent; dead times stay as they are.
        cases: in place of random scenarios, those cases of the task that these patterns name. The result says which they are, so
            that the others can judge it.
        metric: number that is the cost, for example 'settling.q1' or 'at_limit'; the cost has the opposite sign
            where larger is better. None: the problem's headline metric, or the relative error.
        compiled: whether runs use compiled C. None: where all settings of the search can be live, so that one compiled loop
            serves all trials; other settings are other C code, and compiling pays only where runs last longer than the compiler.
        population: number of trials that are proposed at once, from all before them, and run side by side; 1 learns from every one.
        progress: function of (controller, trials done, trials in all) that is called after every trial.

    Raises:
        InvalidProblem: no search space, or draws that could leave physical bounds.
        NotSupported: Optuna is not installed.
        InvalidName, InvalidValue: an unknown metric, or one without a better direction.
        OutputError: the folder cannot be written, or holds results under other conditions.
    """
    optuna = _optuna()
    names = _tunable(task, controllers)
    for what, value in (("trials", trials), ("population", population)):
        if not 1 <= value <= _MOST:
            raise InvalidValue(f"{what} {value}: expected at least 1, and at most {_MOST}")
    # One scenario may be without draws: it is the problem itself.
    numbers = scenario_numbers(task, None if cases is not None and count == 1 else count, percent, cases, same=True)
    # A generation is a call of its own, so its runs alone fill a register.
    many = len(numbers) * population >= _REGISTER and trials * len(numbers) >= SIDE_BY_SIDE
    many = begun_with(folder / LEDGER, "side_by_side", many)
    aim = objective(task.headline_metric if metric is None else metric, task.metrics, task.problem)
    conditions = Conditions(
        seed,
        TUNING,
        float(percent),
        compiled,
        named=cases is not None,
        side_by_side=many,
        judged=is_of_judgements(aim.metric),
    )
    header = {
        **fingerprint(task, conditions),
        "scenarios": list(numbers),
        "optuna": optuna.__version__,
        "metric": aim.name,
        **({"population": population} if population > 1 else {}),
        "tuning": describe(task.tuning),
    }
    with Ledger(folder / LEDGER, header, TrialFields) as ledger:
        entries = tuple(
            _tuned(optuna, task, n, conditions, numbers, (trials, population), aim, ledger, progress) for n in names
        )
    words = f"{count} scenario{'s' if count > 1 else ''} within {percent:g} %"
    words += ", with the problem's dead times" if percent and is_late(task.problem) else ""
    if cases is not None and task.cases is not None:
        words = f"cases {', '.join(task.cases.names[k] for k in numbers)}: {len(numbers)} of {len(task.cases.names)}"
    untouched = tuple(n for n in task.controllers if n not in names)
    units = {path: unit_of_setting(path, task.problem) for entry in entries for path in entry.settings}
    return Tuning(task.name, trials, seed, words, aim.name, entries, untouched, {**units, aim.name: aim.unit})


@dataclass(frozen=True)
class TrialFields(Checked):
    """The fields of a record of one trial."""

    controller: str
    trial: int
    shares: Mapping[str, float]
    settings: Mapping[str, float]
    cost: float
    failures: CountOrZero


def _optuna() -> ModuleType:
    optuna: ModuleType = package("optuna", "tune", "tuning")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _example(task: Task) -> str:
    """A search space of this task: a gain around its number, of the first controller that adapts."""
    for name, controller in task.controllers.items():
        for path in paths_to("gain", controller):
            value = content_at(controller, path)
            if not path.startswith("optimiser.") and isinstance(value, float) and value:
                low, high = sorted((3 * value, value / 10))
                return f"{{{name!r}: {{{path!r}: fpirhc.LogSpan({low:.2g}, {high:.2g})}}}}"
    return f"{{{next(iter(task.controllers))!r}: {{'tracking.rate': fpirhc.LogSpan(1, 20)}}}}"


def _tunable(task: Task, names: Sequence[str] | None) -> list[str]:
    if not task.tuning:
        raise InvalidProblem(
            f"problem '{task.name}' has no search space for tuning; add to its file, for example, "
            f"tuning = {_example(task)}"
        )
    selected = list(select(task, names)) if names else list(task.tuning)
    spanless = [n for n in selected if not task.tuning.get(n)]
    if spanless:
        raise InvalidProblem(f"problem '{task.name}': its tuning has no search space for controller '{spanless[0]}'")
    return selected


def _tuned(
    optuna: ModuleType,
    task: Task,
    name: str,
    conditions: Conditions,
    numbers: Sequence[int],
    budget: tuple[int, int],
    aim: Objective,
    ledger: Ledger,
    progress: Progress | None,
) -> TunedController:
    spans, (trials, population) = task.tuning[name], budget
    known = {r["trial"]: r for r in ledger.records if r["controller"] == name}
    before = {path: current_setting(task.controllers[name], path) for path in spans}
    # A trial keeps its cost alone, so no other metric is measured.
    needed = [metric for metric in task.metrics if metric.name in ("rms_error", aim.metric.name if aim.metric else "")]
    runs = Trials(replace(task, metrics=needed), name, tuple(spans), conditions)
    study = optuna.create_study()
    ranges = dict.fromkeys(spans, optuna.distributions.FloatDistribution(0.0, 1.0))
    generations = [range(at, min(at + population, trials)) for at in range(0, trials, population)]
    for generation in (range(_PRESENT, _PRESENT + 1), *generations):
        lacking = [number for number in generation if number not in known]
        # Known ones of a generation are proposed too: an interrupted search goes on with the proposals that it would have had.
        proposed = [number for number in generation if lacking and number != _PRESENT]
        asked = {number: _proposal(optuna, study, ranges, conditions.seed, number) for number in proposed}
        new: list[dict[str, Any]] = []
        for number in lacking:
            shares = dict(asked[number].params) if number in asked else {}
            settings = _numbers(task, name, spans, shares) if number in asked else before
            new.append({"controller": name, "trial": number, "shares": shares, "settings": settings})
        for record, judged in zip(new, _judged(runs, numbers, aim, [one["settings"] for one in new]), strict=True):
            ledger.append(record | judged)
            known[record["trial"]] = record | judged
            if progress:
                progress(name, record["trial"] + 1, trials)
        for number in generation:
            if number in asked:
                study.tell(asked[number], known[number]["cost"])
            elif number != _PRESENT:
                shares, cost = known[number]["shares"], known[number]["cost"]
                study.add_trial(optuna.trial.create_trial(params=shares, distributions=ranges, value=cost))
    tried = [known[n] for n in range(_PRESENT, trials)]
    best = min(tried, key=lambda r: (r["cost"], r["trial"]))
    failed = sum(bool(r["failures"]) for r in tried[1:])
    changed = with_settings(task.controllers[name], best["settings"])
    compiled = bool(conditions.compiled)
    harm = harm_of_adaptation(task.problem, name, changed, seed=conditions.seed, compiled=compiled)
    return TunedController(name, before, best["settings"], tried[0]["cost"], best["cost"], failed, harm)


def _proposal(optuna: ModuleType, study: Any, ranges: Mapping[str, Any], seed: int, number: int) -> Any:
    """Optuna's trial `number` with shares of the spans to try, given all trials before it; its cost is told to the study later."""
    state = int(np.random.SeedSequence(seed, spawn_key=(TUNING, number)).generate_state(1)[0])
    study.sampler = optuna.samplers.TPESampler(seed=state)
    return study.ask(ranges)


def _numbers(task: Task, name: str, spans: TuningSpans, shares: Mapping[str, float]) -> dict[str, float]:
    settings = {path: span.number(shares[path]) for path, span in spans.items()}
    return {p: round(v) if is_whole(task.controllers[name], p) else v for p, v in settings.items()}


def _judged(
    trials: Trials, scenarios: Sequence[int], aim: Objective, some: Sequence[Mapping[str, float]]
) -> Iterator[dict[str, float]]:
    """Cost of each of these settings, and in how many scenarios they fail; settings that are refused fail in all of them."""
    refused = {"cost": aim.refused, "failures": len(scenarios)}
    try:
        live = not some or trials.live(scenarios)
    except (InvalidValue, InvalidProblem):
        yield from [refused] * len(some)
        return
    records = trials.records([(k, settings) for settings in some for k in scenarios], live=live)
    for _ in some:
        own = list(itertools.islice(records, len(scenarios)))
        failures = sum(r.get("outcome") != "finished" for r in own)
        yield {"cost": math.fsum(map(aim.cost, own)) / len(scenarios), "failures": failures}
