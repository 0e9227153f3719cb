"""Runs of single scenarios of a problem; simulators are built once and used for all scenarios."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import Controller
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import CountOrZero
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import with_settings
from fpirhc.simulation.lanes import Lanes, OneRun
from fpirhc.simulation.metrics import Metric, Metrics, measure
from fpirhc.simulation.metrics.base import first_measured
from fpirhc.simulation.pictures.base import NOT_DRAWN, Kept, Picture
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import JUDGING, Compiled, ComposedLoop, Simulator, with_judgements
from fpirhc.studies.comparison.causes import error_left_alone
from fpirhc.studies.scenarios.draws import NamedCases, RandomScenarios, Scenario, Scenarios, Shared, draws_differ
from fpirhc.studies.view import finite_alone
from fpirhc.task.problem import Problem

_BLOCK = 64  # scenarios that run side by side
_MOST = 10_000_000  # scenarios of a study: a table of their places is kept
SIDE_BY_SIDE = 64  # scenarios from which it pays to compile a loop for lanes


@dataclass(frozen=True)
class Conditions:
    """Everything apart from the task on which the numbers of a scenario depend."""

    seed: int  # of the scenarios
    use: int  # of the scenarios, see `draws`
    percent: float  # range of the exact parameters' draws, percent
    # whether runs use compiled C; None: only those of loops with live settings, which are compiled once
    compiled: bool | None
    named: bool = False  # whether they are the cases of the problem file
    side_by_side: bool = (
        False  # whether runs are side by side where they can be: equal to rounding, see `Bench.records`
    )
    judged: bool = False  # whether runs have the signals that judge them, which take longer than the run


@dataclass(frozen=True)
class RecordFields(Checked):
    """The fields of a record of one controller in one scenario, as `Bench.record` makes it."""

    scenario: CountOrZero
    name: str
    group: str
    controller: str
    mismatch: float
    outcome: str
    error: float | None
    metrics: Mapping[str, object]
    lasted: float
    stop: str | None


@dataclass(frozen=True, eq=False)
class _InLanes:
    """A scenario that runs beside others, and its place among the jobs."""

    place: int
    scenario: Scenario
    run: OneRun


class Bench:
    """Runs scenarios by number and controller.

    Args:
        live: paths of the settings that `record` may change, by name of the controller.

    Raises:
        InvalidProblem, InvalidValue: draws that could leave the parameters' physical bounds.
    """

    def __init__(self, task: Task, conditions: Conditions, live: Mapping[str, Sequence[str]] | None = None) -> None:
        self._live, self._side_by_side = live or {}, conditions.side_by_side and conditions.compiled is not False
        self.apart: dict[str, str] = {}
        self._task, self._conditions = task, conditions
        self._scenarios = scenarios(task, conditions)
        self._ranges, self._held = ranges(task.problem), held(task.problem)
        self._simulators: dict[tuple[str, object], Simulator | FpirhcError] = {}
        self._shared: dict[tuple[str, object], Simulator | None] = {}
        self._known: dict[object, Compiled] = {}
        self._lanes: dict[tuple[str, int], Lanes] = {}  # by controller and code
        self._alone: set[tuple[str, object]] = set()  # controllers and builds without lanes
        self._last: dict[int, Scenario] = {}

    def records(
        self, numbers: Sequence[int], name: str, settings: Sequence[Mapping[str, float] | None] | None = None
    ) -> Iterator[dict[str, Any]]:
        """Yield the results of one controller in several scenarios, as `record` does for each.

        Where the loop can be written for lanes its runs are side by side: metrics are summed up without logs and equal to rounding,
        whatever the other scenarios are. A run that ends early is the ordinary one. `apart` says why a controller's are ordinary.
        """
        jobs = list(zip(numbers, settings or [None] * len(numbers), strict=True))
        found: dict[int, dict[str, Any]] = {}
        for lanes, some in self._groups(name, jobs):
            for one, values in zip(some, lanes.values([one.run for one in some]), strict=True):
                if values is not None:
                    metrics = Metrics(values, {}, {m.name: m for m in self._task.metrics})
                    found[one.place] = self._told(jobs[one.place][0], name, one.scenario, metrics)
        for place, (number, own) in enumerate(jobs):
            yield found[place] if place in found else self.record(number, name, own)

    def blocks(self, name: str, numbers: Sequence[int] | np.ndarray) -> Iterator[list[int]]:
        """Yield the scenarios in pieces for `records`: single ones where a controller's runs are one after the other."""
        if self._side_by_side and len(numbers) and self._scenarios.has_many_alike(int(numbers[0])):
            with contextlib.suppress(FpirhcError):  # it is said by the first record
                self._lanes_of(name, self._scenario(int(numbers[0])))
        size = _BLOCK if self._side_by_side and name not in self.apart else 1
        yield from (list(map(int, numbers[at : at + size])) for at in range(0, len(numbers), size))

    def _groups(
        self, name: str, jobs: Sequence[tuple[int, Mapping[str, float] | None]]
    ) -> list[tuple[Lanes, list[_InLanes]]]:
        """The lanes, and those jobs that may run in them: of one loop, one duration and one first measured cycle."""
        groups: dict[tuple[int, int, int], tuple[Lanes, list[_InLanes]]] = {}
        for place, (number, settings) in enumerate(jobs if self._side_by_side else ()):
            if not self._scenarios.has_many_alike(number):
                continue
            scenario = self._scenario(number)
            with contextlib.suppress(FpirhcError):  # what is wrong is said by the record
                found = self._lanes_of(name, scenario)
                if found is None:
                    continue
                lanes, ready = found
                alone = self._scenarios.differ_in_exact_alone and not settings
                run = lanes.one_run(ready, scenario.problem, scenario.seed, settings, exact_alone=alone)
                key = id(lanes), run.problem.cycles, first_measured(run.problem)
                groups.setdefault(key, (lanes, []))[1].append(_InLanes(place, scenario, run))
        return list(groups.values())

    def _lanes_of(self, name: str, scenario: Scenario) -> tuple[Lanes, Simulator] | None:
        """The lanes of a scenario's loop, and the loop; None where its runs are one after the other."""
        key = name, scenario.build
        if key in self._alone:
            return None
        ready = self._simulator(name, scenario)
        code = name, id(ready.evaluator)
        if code not in self._lanes:
            shown = [one.title for one in self._pictures(name) if one.keeps]
            why = f"the picture '{shown[0]}' keeps something of every run" if shown else ""
            why = "the figure is of signals that judge a whole run" if self._conditions.judged else why
            self._lanes[code] = Lanes(ready, self._task.metrics, why=why)
        lanes = self._lanes[code]
        if lanes.why:
            self._alone.add(key)
            self.apart[name] = lanes.why
            return None
        return lanes, ready

    def record(self, number: int, name: str, settings: Mapping[str, float] | None = None) -> dict[str, Any]:
        """Return the result of one controller in one scenario, as plain data; a number that is not finite becomes None.

        A controller that cannot serve the problem, or not with these live settings, gives {"controller": its name, "skipped": the
        reason}.
        """
        scenario = self._scenario(number)
        try:
            ready = self._simulator(name, scenario)
            run = ready.run(seed=scenario.seed, name=name, variant=scenario.problem, settings=settings)
            if self._conditions.judged:
                force = ready.in_force(scenario.problem, settings)
                run = with_judgements(run, force.problem, force.controller)
        except FpirhcError as error:
            return {"controller": name, "skipped": str(error)}
        metrics = measure(scenario.problem, run, self._task.metrics)
        return self._told(number, name, scenario, metrics, run)

    def _told(
        self, number: int, name: str, scenario: Scenario, metrics: Metrics, run: Run | None = None
    ) -> dict[str, Any]:
        """The record; without a run, that of one which finished and of which nothing is kept."""
        size = relative_error(metrics, self._ranges)
        stop = None if run is None else run.stop
        return {
            "scenario": number,
            "name": scenario.name,
            "group": scenario.group,
            "controller": name,
            "mismatch": scenario.mismatch,
            "outcome": outcome(stop, self._judged(scenario, metrics, size)),
            "error": finite_alone(size),
            "metrics": finite_alone(metrics.values),
            "pictures": {} if run is None else finite_alone(self._kept(name, run)),
            "lasted": 1.0 if run is None else run.cycles / scenario.problem.cycles,
            "stop": stop,
        }

    def _judged(self, scenario: Scenario, metrics: Metrics, size: float) -> float:
        """The relative error by which a run has diverged: where a reference is held, beside the plant left alone."""
        if not DIVERGED < size < math.inf or not self._held:
            return size
        alone = error_left_alone(scenario.problem, seed=scenario.seed)
        sizes = {c: max(r, alone.get(c, 0.0)) if c in self._held else r for c, r in self._ranges.items()}
        return relative_error(metrics, sizes)

    def _kept(self, name: str, run: Run) -> dict[str, Kept]:
        """What the pictures of many runs need of this one, by title."""
        kept = {one.title: _kept_of(one, run) for one in self._pictures(name) if run.cycles > 1}
        return {title: facts for title, facts in kept.items() if facts}

    def _pictures(self, name: str) -> list[Picture]:
        return [one for one in self._task.pictures if not one.controllers or name in one.controllers]

    def _scenario(self, number: int) -> Scenario:
        """The scenario; those of a block are kept, because controllers take turns on it."""
        if number not in self._last:
            if len(self._last) >= _BLOCK:
                self._last.pop(next(iter(self._last)))
            self._last[number] = self._scenarios[number]
        return self._last[number]

    def _simulator(self, name: str, scenario: Scenario) -> Simulator:
        key = name, scenario.build
        ready = self._simulators.get(key)
        if ready is None or (isinstance(ready, Simulator) and ready.remembers):
            ready = self._simulators[key] = self._built(name, scenario)
        if isinstance(ready, FpirhcError):
            raise ready
        return ready

    def changes(self, name: str, number: int = 0) -> bool:
        """Whether the live settings of a controller can be changed in a scenario: its loop can be built with them."""
        with contextlib.suppress(FpirhcError):
            self._simulator(name, self._scenario(number))
            return True
        return False

    def _built(self, name: str, scenario: Scenario) -> Simulator | FpirhcError:
        live, compiled = self._live.get(name, ()), self._conditions.compiled
        compile_it = compiled if compiled is not None else bool(live)
        once = scenario.alone and compile_it and not live  # a loop that runs once: compiled where the run is long
        try:
            controller = self._scenarios.automatic(self._task.controllers[name])
            many = None if once else scenario.shared
            shared = self._shared_loop(name, controller, many, compile_it) if many else None
            if shared is not None:
                checked(scenario.built, controller)
                return shared
            loop = ComposedLoop.of(scenario.built, controller, live)
            return loop.simulator(None if once else compile_it, known=self._known)
        except FpirhcError as error:
            return error

    def _shared_loop(self, name: str, controller: Controller, shared: Shared, compile_it: bool) -> Simulator | None:
        """The loop that serves more scenarios; None where it cannot be built with these live settings."""
        key = name, shared.key
        if key not in self._shared:
            live = (*self._live.get(name, ()), *shared.live)
            try:
                ready = ComposedLoop.of(shared.built, controller, live).simulator(compile_it, known=self._known)
                self._shared[key] = None if ready.remembers else ready
            except FpirhcError:  # what is wrong in every scenario is said by the loops of their own
                self._shared[key] = None
        return self._shared[key]


def is_of_judgements(metric: Metric | None) -> bool:
    """Whether a figure of merit is of the signals that judge a run, which a study computes where somebody asks for them."""
    return metric is not None and bool({*JUDGING} & {*(metric.reads or ())})


def scenarios(task: Task, conditions: Conditions) -> Scenarios:
    """Return the scenarios of a study."""
    if conditions.named:
        assert task.cases is not None
        return NamedCases(task.cases, task.problem, conditions.seed)
    return RandomScenarios(task.problem, conditions.seed, conditions.use, conditions.percent)


class Trials:
    """Runs of one controller with other numbers of its settings: in one loop where they can be live, else in one for each set.

    Args:
        task: the loaded problem file.
        name: of the controller.
        paths: of the settings.
        conditions: of the scenarios.
    """

    def __init__(self, task: Task, name: str, paths: Sequence[str], conditions: Conditions) -> None:
        self._task, self._name, self._paths = replace(task, controllers={name: task.controllers[name]}), name, paths
        self._conditions = conditions
        self._rebuilt: tuple[dict[str, float], Bench] | None = None

    @cached_property
    def _bench(self) -> Bench:
        live = {self._name: self._paths}
        return Bench(self._task, self._conditions, live)

    @property
    def apart(self) -> str:
        """Why runs were not side by side; empty where they were."""
        bench = self._bench if self._rebuilt is None else self._rebuilt[1]
        return bench.apart.get(self._name, "")

    def live(self, scenarios: Sequence[int] = (0,)) -> bool:
        """Whether the settings can be live in these scenarios."""
        return not self._paths or all(self._bench.changes(self._name, k) for k in scenarios)

    def records(self, jobs: Sequence[tuple[int, Mapping[str, float]]], *, live: bool) -> Iterator[dict[str, Any]]:
        """Yield the records of scenarios with these numbers; the loop that is built for numbers that are not live is kept.

        Numbers that the controller does not take are a reason why a scenario is skipped.
        """
        if live:
            numbers, settings = [k for k, _ in jobs], [own or None for _, own in jobs]
            yield from self._bench.records(numbers, self._name, settings)
            return
        for settings, group in itertools.groupby(jobs, key=lambda job: job[1]):
            some = [k for k, _ in group]
            try:
                yield from self._built(settings).records(some, self._name)
            except FpirhcError as error:
                yield from [{"controller": self._name, "skipped": str(error)}] * len(some)

    def _built(self, settings: Mapping[str, float]) -> Bench:
        if self._rebuilt is None or self._rebuilt[0] != settings:
            changed = with_settings(self._task.controllers[self._name], settings)
            task = replace(self._task, controllers={self._name: changed})
            alone = replace(self._conditions, side_by_side=False)
            self._rebuilt = dict(settings), Bench(task, alone)
        return self._rebuilt[1]


def scenario_numbers(
    task: Task, count: int | None, percent: float, cases: Sequence[str] | None, *, same: bool = False
) -> Sequence[int]:
    """Return the numbers of the scenarios of a study.

    Args:
        count: number of random scenarios; None beside cases.
        percent: range of the exact parameters, percent.
        same: whether all scenarios may be the same one.
    """
    if cases is not None:
        if count is not None or percent:
            raise InvalidValue("cases are what they are: give either cases, or a number of scenarios and a mismatch")
        if task.cases is None:
            raise InvalidValue(
                f"problem '{task.name}' has no cases; add to its file cases = fpirhc.Cases({{'heavy': {{'exact.mass': 2.0}}}}), or "
                "fpirhc.Cases.from_csv('cases.csv')"
            )
        wanted = task.cases.matching(cases)
        for name in wanted:  # what is wrong with a case is said before the first run
            task.cases.problem(name, task.problem)
        return [task.cases.names.index(name) for name in wanted]
    if count is None or not 1 <= count <= _MOST:
        raise InvalidValue(f"scenarios {count}: expected at least 1, and at most {_MOST}")
    if not same and not _differ(task.problem, percent):
        mend = "give --mismatch P" if not percent else "state parameters of the plant, or a dead time"
        raise InvalidValue(
            "every scenario would be the same: the problem has no disturbances, no sensor noise, and no parameter or dead time "
            f"that is drawn; {mend}"
        )
    return range(count)


def _differ(problem: Problem, percent: float) -> bool:
    """Whether scenarios differ: in noise, in what a body outside makes of its seed, or in what is drawn."""
    noisy = bool(problem.disturbances) or not problem.sensing.ideal or problem.foreign is not None
    return noisy or draws_differ(problem, percent)


def _kept_of(picture: Picture, run: Run) -> Kept:
    try:
        return picture.kept(run)
    except FpirhcError as error:  # a mistake in a picture costs no run
        return {NOT_DRAWN: str(error)}


DIVERGED = 1.0  # relative error above which a run that lasted to its end has diverged: as large as the motion itself
_SAMPLES = 2000
_ROUNDING = 1e-9


def ranges(problem: Problem) -> dict[str, float]:
    """Return the range of the reference of every judged coordinate.

    The error at the start stands for it where that is larger, and 1 where both are zero.
    """
    rows = _wanted(problem)
    sizes = np.maximum(np.ptp(rows, axis=1), np.abs(rows[:, 0] - problem.start_output[_places(problem)]))
    return {c: float(s) if s > 0 else 1.0 for c, s in zip(problem.judged_names, sizes, strict=True)}


def held(problem: Problem) -> frozenset[str]:
    """Return the judged coordinates whose reference does not move: disturbances move them."""
    rows = _wanted(problem)
    still = np.ptp(rows, axis=1) <= _ROUNDING * np.abs(rows).max(axis=1)
    return frozenset(c for c, one in zip(problem.judged_names, still, strict=True) if one)


def _wanted(problem: Problem) -> np.ndarray:
    """The reference of the judged coordinates over the run, by rows."""
    times = np.linspace(0.0, problem.duration, _SAMPLES)
    states = problem.reference.function(problem.plant).map(_SAMPLES)(times[None, :])[0]
    return np.asarray(states.full())[_places(problem)]


def _places(problem: Problem) -> list[int]:
    return [problem.plant.output.elements.index(c) for c in problem.judged_names]


def relative_error(metrics: Metrics, sizes: dict[str, float]) -> float:
    """Return the rms error divided by the reference's range, root mean square over the judged coordinates.

    The error of a run that ended early is infinite, larger than that of every other run.
    """
    shares = [rms / sizes[c] for c, rms in metrics.rms_error.items()]
    error = math.sqrt(math.fsum(s * s for s in shares) / len(shares))
    return error if math.isfinite(error) else math.inf


def outcome(stop: str | None, error: float) -> str:
    """Return 'finished', 'diverged' or 'ended early'."""
    if stop is not None:
        return "ended early"
    return "finished" if error <= DIVERGED else "diverged"
