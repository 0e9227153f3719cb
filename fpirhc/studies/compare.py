"""Runs several controllers on one problem, pairs them, and judges the effect of adaptation."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from fpirhc.contraction.delayed import largest_behind_estimator
from fpirhc.contraction.spectrum import ContractionReport, assess_gain
from fpirhc.controllers.base import Controller
from fpirhc.controllers.built import checked
from fpirhc.controllers.contract import resolved
from fpirhc.controllers.reference_states import beyond_limits
from fpirhc.errors import FpirhcError, InvalidName, InvalidProblem, Mistakes, NotContractive, nearest
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.plant.chain import response_names
from fpirhc.plant.motion import SECONDS
from fpirhc.problem_files.problem_file import Task, pair_of
from fpirhc.problem_files.shipped import shipped_folders
from fpirhc.review.experiments import slips
from fpirhc.review.review import recommended_for
from fpirhc.simulation.metrics import Metrics, columns, in_report, measure
from fpirhc.simulation.metrics.shipped import sampled_spectrum
from fpirhc.simulation.ranges import Followed, hard_limits, input_limits, limits_left, misplaced
from fpirhc.simulation.replay import raw_measurements
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import Simulator
from fpirhc.simulation.stepper import ComposedStep, Stepper
from fpirhc.simulation.trials import ErrorPair, ModelAsPlant, errors_of, weighed
from fpirhc.studies import Progress, Study, View, circumstances, status_shares
from fpirhc.studies.verdict import NULL, Finding, Outcome, Yardstick, by_reason, findings, follows, objective
from fpirhc.summary import Column, Table, in_percent, number, written_out
from fpirhc.symbolic.evaluate import attempted
from fpirhc.symbolic.native import compile_all
from fpirhc.task.problem import Problem


def select(task: Task, names: Sequence[str] | None) -> dict[str, Controller]:
    """Return the named controllers of a task in the given order; all of them when no names are given."""
    mistakes = Mistakes(f"problem '{task.name}'")
    mistakes.unknown("controller", names or (), task.controllers)
    if mistakes and any("," in name for name in names or ()):
        mistakes.add("names are separated by spaces, without commas")
    mistakes.raise_if_any()
    return {name: task.controllers[name] for name in names or task.controllers}


def check_gains(task: Task, controllers: Mapping[str, Controller]) -> None:
    """Raise for gains of the wrong sign, which are mistakes in the file and no results, before anything runs."""
    mistakes, owners = Mistakes(f"problem '{task.name}'"), dict[str, list[str]]()
    for name, controller in controllers.items():
        try:
            checked(task.problem, controller)
        except NotContractive as error:
            best, slipped = recommended_for(task.problem, controller), _slips(task.problem)
            told = " ".join([*slipped, *[f"{error}{best and f'. {best}'}"] * (not (slipped and error.turned))])
            owners.setdefault(told, []).append(f"'{name}'")
        except FpirhcError:
            continue  # reported later, as the reason why the controller is skipped
    for why, names in owners.items():
        mistakes.add(f"controller{'s' * (len(names) > 1)} {', '.join(names)}: {why}")
    mistakes.raise_if_any()


@dataclass(frozen=True)
class Contraction:
    """The factor by which the iteration shrinks an error per cycle."""

    growing: float  # share of the cycles in which small errors grow
    measured: float  # NaN: the response is late, or does not move in every direction
    report: ContractionReport

    def said(self, lost: bool) -> str:
        """What it leaves of an error, which gains converge, and what the run shows."""
        one, text = self.report, f"{self.report.text}."
        if one.converging and not lost:
            text += f" The iteration alone converges for {one.converging}; the loop may bear less: fpirhc review."
        return text + f" The run shows {written_out(self.measured)}." * bool(np.isfinite(self.measured))


@dataclass(frozen=True, eq=False)
class Entry:
    """One controller's row."""

    name: str
    run: Run
    metrics: Metrics
    adaptive: bool
    pair: str | None  # name of the same controller without adaptation
    weighed: frozenset[str] | None  # judged coordinates that its cost weighs; None: all
    exact: bool  # whether its model is exact where the others' is not
    contraction: Contraction | None = None
    null: ErrorPair | None = None  # errors on its own model, without adaptation and with it
    cycle: tuple[float, ...] = ()  # median time of a cycle, that of 99 %, and the longest, us; share above the period
    limits: tuple[Followed, ...] = ()  # along the run: those of inputs, and hard ones of states, rates and paths
    left: tuple[Followed, ...] = ()  # those that it leaves, the worst first
    notes: tuple[str, ...] = ()

    @property
    def errors(self) -> Mapping[str, float]:
        """Rms error by judged coordinate."""
        return self.metrics.rms_error


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Comparison(Study):
    """The result of `compare`."""

    seed: int
    task: Task
    entries: tuple[Entry, ...]
    skipped: Mapping[str, str]

    @cached_property
    def _yard(self) -> Yardstick:
        return Yardstick.of(self.task.problem, self.seed)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What the file says, the headline pair, then the others, the best row, and what was not run."""
        task, yard = self.task, self._yard
        found = findings(self.entries, task, yard, self.skipped, _causes(task.problem, self.entries, yard))
        return (*found, *_without_noise(task, found[0].pair))

    @cached_property
    def lost(self) -> frozenset[str]:
        """Names of the rows that end early or, where errors are judged, do not follow."""
        judged = self.task.headline_metric is None
        return frozenset(e.name for e in self.entries if e.run.stop or (judged and not follows(e, self._yard)))

    @property
    def verdict(self) -> tuple[str, ...]:
        """The verdict in sentences."""
        return tuple(finding.text for finding in self.findings)

    @property
    def outcome(self) -> Outcome:
        """What the first sentence states."""
        return self.findings[0].outcome or Outcome.NOT_COMPARABLE

    def __getitem__(self, name: str) -> Entry:
        for entry in self.entries:
            if entry.name == name:
                return entry
        raise InvalidName(f"controller '{name}' is not here.{nearest(name, [e.name for e in self.entries])}")

    @property
    def view(self) -> View:
        shown = columns([e.metrics for e in self.entries], in_report)
        rivals = {e.name: e for e in self.entries if not e.exact and e.name not in self.lost}  # whose best is marked
        best = {c: c.best([c.number(e.metrics) for e in rivals.values()]) for c in shown if c.metric.main}
        best = {c: number for c, number in best.items() if number is not None}
        docs = {c.metric: (c.metric.function.__doc__ or "").partition("\n")[0] for c in shown}
        said = {metric: text.removeprefix("Return ").rstrip(".") for metric, text in docs.items()}
        heads = [Column(c.heading, c.short if c.metric.main else None, note=said[c.metric]) for c in shown]
        heads = [Column("controller"), Column("status", left=True), *heads, Column("cycle / 99 % / longest [us]")]
        caption = "; ".join(f"{m.short or m.heading}: {text}" for m, text in said.items() if m.main and text)
        table = Table(self.title, heads, caption)
        for e in self.entries:
            numbers = [(c, c.number(e.metrics)) for c in shown]
            marked = [k for k, (c, v) in enumerate(numbers, 2) if e.name in rivals and v == best.get(c, np.nan)]
            texts = [c.text(v, missing="", none="none") for c, v in numbers]
            cycle = " / ".join(map(written_out, e.cycle[:3]))
            table.add([e.name, self._status(e), *texts, cycle], "red" if e.left else "", marked)
        problem = self.task.problem
        about = f"Errors from t = {number(problem.measure_from)} {problem.time_unit} on, seed {self.seed}."
        notes = [CLOCK] * any(e.cycle for e in self.entries)
        notes += [f"{e.name}: {note}" for e in self.entries for note in e.notes]
        colours = [f.outcome for f in self.findings]
        if colours[0] is Outcome.BETTER and Outcome.NOT_GOOD in colours:
            colours[0] = Outcome.NOT_GOOD
        null = [f"{e.name}: {e.null.sentence}; {e.null.movement}" for e in self.entries if e.null is not None]
        lists = {"Notes": notes, f"Null tests: {NULL}": null}
        lost = {f.pair[1] for f in self.findings if f.pair and f.outcome in (Outcome.WORSE, Outcome.NOT_COMPARABLE)}
        lost |= self.lost
        lists["Contraction"] = [f"{e.name}: {c.said(e.name in lost)}" for e in self.entries if (c := e.contraction)]
        return View(self, [*zip(self.verdict, colours, strict=True)], about, (table.filled,), self._facts(), lists)

    def _status(self, entry: Entry) -> str:
        """What speaks against a run; 'ok' where nothing does."""
        if stop := entry.run.stop:  # the first sentence may state the reason, above the table
            said = ["ended early" if stop in self.findings[0].text else f"ended early: {stop.partition(';')[0]}"]
        else:
            said = ["does not follow"] * (entry.name in self.lost) + [status_shares(entry.metrics.statuses)]
            said += [s for s, _ in self._yard.shortfalls(entry, not said[0] and self.task.headline_metric is None)]
        said += [f"late in {in_percent(late)} of the cycles" for late in entry.cycle[3:] if late > LATE]
        said += [f"limit of {', '.join(one.name for one in entry.left)} violated"] * bool(entry.left)
        return ", ".join(filter(None, said)) or "ok"

    def _facts(self) -> dict[str, Any]:
        rows = dict[str, Mapping[str, Any]]()
        for e in self.entries:
            own = {"metrics": e.metrics.numbers, "cycle_us": e.cycle[:3] or None, "notes": e.notes}
            rows[e.name] = own | {"stop": e.run.stop}
        found = [{"text": f.text, "outcome": f.outcome, "pair": f.pair, "ratios": f.ratios} for f in self.findings]
        facts = {"problem": self.problem, "seed": self.seed, "versions": self.versions, "outcome": str(self.outcome)}
        return {**facts, "findings": found, "controllers": rows, "skipped": self.skipped}


@checked_call
def compare(
    task: Task,
    *,
    seed: Seed,
    controllers: Sequence[str] | None = None,
    compiled: bool | None = True,
    command: str = "",
    progress: Progress | None = None,
) -> Comparison:
    """Run the task's controllers with the same disturbances and return their results.

    Args:
        task: problem and controllers; the pairs are those that differ in their adaptation alone.
        seed: of the noise.
        controllers: names; None: all.
        compiled: whether loops run as compiled C; None: where runs are long.
        command: that reproduces the comparison.
        progress: called with (controller or 'compiling', cycles done, cycles in all).
    """
    begin, selected = time.perf_counter(), select(task, controllers)
    check_gains(task, selected)
    problem, skipped = task.problem, dict[str, str]()
    objective(task.headline_metric, task.metrics, problem)  # a wrong one is told before anything runs
    rows, entries = _Rows(task, selected, seed, compiled), list[Entry]()
    for name in selected:
        try:
            rows.compose(name)
        except FpirhcError as error:
            skipped[name] = str(error)
    if not rows.composed:
        told = "; ".join(f"{', '.join(names)}: {why}" for why, names in by_reason(skipped).items())
        raise InvalidProblem(f"{task.place}{told}")
    tell = progress if progress and rows.wanted else lambda *_: None
    tell("compiling", 0, 1)
    compile_all(rows.wanted)
    tell("compiling", 1, 1)
    for name in rows.composed:
        try:
            entries.append(rows.entry(name, progress and partial(progress, name)))
        except FpirhcError as error:
            skipped[name] = str(error)
        except KeyboardInterrupt:
            done = {*skipped, *(e.name for e in entries)}
            skipped |= dict.fromkeys([n for n in rows.composed if n not in done], "interrupted before it finished")
            break
    facts = circumstances(task, selected, command, begin)
    return Comparison(**facts, seed=seed, task=task, entries=tuple(entries), skipped=skipped)


def _causes(problem: Problem, entries: Sequence[Entry], yard: Yardstick) -> list[str]:
    """What the file itself says of loops that do not follow, or leave a limit."""
    placed = [f"{text[0].upper()}{text[1:]}." for text in misplaced(problem)]
    lost = any(not e.adaptive and (not follows(e, yard) or yard.shortfalls(e, True)) for e in entries)
    return [*placed, *(_slips(problem) or beyond_limits(problem) if lost else [])]


def _slips(problem: Problem) -> list[str]:
    return [f"{told[0].upper()}{told[1:]}. {change}" for told, change, _ in slips(problem)]


class _Rows:
    """The loops of a comparison, each composed and compiled once, and the row of each."""

    def __init__(self, task: Task, controllers: Mapping[str, Controller], seed: int, compiled: bool | None) -> None:
        self._task, self._controllers, self._seed, self._compiled = task, controllers, seed, compiled
        self.composed: dict[str, tuple[Simulator, ComposedStep | None]] = {}
        self.wanted: list[tuple[Any, int]] = []  # Functions to be compiled, and so many calls of each
        self._model = ModelAsPlant(task.problem, seed=seed)

    def compose(self, name: str) -> None:
        """Compose a loop, and its step by hand."""
        problem = self._task.problem
        loop = Simulator.of(problem, resolved(problem, self._controllers[name]), self._compiled)
        facts: dict[str, Any] = {"bounded": False, "broken": []}
        step = attempted("the time of a cycle", ComposedStep.of, problem, loop.controller, **facts)
        self.composed[name] = loop, step
        if loop.calls:
            self.wanted += [(loop.loop.function, loop.calls), *([(step.function, 0)] if step is not None else [])]

    def entry(self, name: str, progress: Callable[[int, int], None] | None) -> Entry:
        """Run a controller; a part that breaks is told, and loses no run."""
        problem, broken = self._task.problem, list[str]()
        part, (loop, step) = partial(attempted, broken=broken), self.composed[name]
        run = loop.run(seed=self._seed, name=name, progress=progress)
        ready, metrics = loop.controller, measure(problem, run, self._task.metrics)
        pair = pair_of(self._controllers, name) if ready.deformation.adapts else None
        pair = pair if pair in self.composed else None
        judged = weighed(problem, ready)
        null = part("the null test", self._null, pair, name, judged) if pair is not None else None
        cycle = (part("the time of a cycle", _cycle_time, step, loop.compiled, run) if step is not None else None) or ()
        contraction = part("the contraction", _contraction, problem, ready, run, metrics)
        left = limits_left(limits := (*input_limits(problem, run), *hard_limits(problem, run)))
        told = [one.sentence for one in left]
        notes = (*told, *ready.notes(problem), *run.remarks, *broken, *metrics.broken.values())
        adapts, exact = ready.deformation.adapts, _has_exact_model(problem, ready)
        return Entry(name, run, metrics, adapts, pair, judged, exact, contraction, null, cycle, limits, left, notes)

    def _null(self, pair: str, name: str, judged: frozenset[str] | None) -> ErrorPair:
        return errors_of(*self._model.pair((self.composed[pair][0], self.composed[name][0])), judged)


def _contraction(problem: Problem, controller: Controller, run: Run, metrics: Metrics) -> Contraction | None:
    if not metrics.numbers.get("contraction.predicted"):
        return None
    spectrum, late = sampled_spectrum(problem, run), problem.response_delay
    growing, measured = metrics["contraction.growing"][""], metrics["contraction.measured"].get("", np.nan)
    growing = 0.0 if late else growing  # behind a delay the iteration is another one, which was asked before the run
    largest = largest_behind_estimator(problem, controller.deformation)
    return Contraction(growing, measured, assess_gain(controller.deformation, spectrum, late, largest))


def _has_exact_model(problem: Problem, controller: Controller) -> bool:
    """Whether it is the bound of a controller with a wrong model: parameters known as exact, nothing adapted, nothing learned."""
    wrong = problem.reality is not None or not np.array_equal(problem.plant.approximate, problem.plant.exact)
    fixed = not controller.deformation.adapts and not controller.learns and problem.moves.simulated
    return wrong and fixed and controller.exact_model


def _without_noise(task: Task, pair: tuple[str, str] | None) -> list[Finding]:
    """A sentence where the response that the first pair adapts is measured as no sensor does."""
    problem = task.problem
    if not pair or not problem.moves.simulated or task.controllers[pair[1]].deforms in ("target", "turns"):
        return []
    shown = {*problem.sensing.measures(problem.plant)} - {n for n, one in problem.sensing.sensors.items() if one.acts}
    file = task.name if any(folder in task.path.parents for folder in shipped_folders()) else str(task.path)
    words = shlex.join(["fpirhc", "study", file, "--margins", "noise", "-c", *pair])
    text = f"{pair[1]} measures its response without noise; what noise costs: {words}"
    return [Finding(text)] if {*response_names(problem.plant)} <= shown else []


REPLAYED = 2000  # cycles of a run that are stepped again, one by one
LATE = 0.01  # of the cycles, up to which they are late by the operating system and the clock
CLOCK = "A cycle is a call of the controller, from measurement to command: the median, what 99 % take at most, and the longest."


def _cycle_time(composed: ComposedStep, compiled: bool, run: Run) -> tuple[float, ...]:
    """Median, 99 % and longest wall time of a call of the controller, us, and the share of calls longer than the period."""
    stepper, count = Stepper.of(composed, compiled=compiled), min(run.cycles, REPLAYED)
    if not count:
        return ()
    step: Callable[..., Any] = stepper.step_measured if stepper.estimates else stepper.step
    samples: tuple[np.ndarray, ...] = (run.time, run["state"], run["realised"])
    if stepper.estimates:
        samples = run.time, raw_measurements(run)
    elif stepper.beside:
        step = lambda now, x, r, y, memory: stepper.step(now, x, r, memory, output=y)  # noqa: E731
        samples = *samples, run["output"]
    memory, taken = stepper.start(), np.empty(count)
    for k in range(count):
        begin = time.perf_counter_ns()
        _, memory = step(*(signal[k] for signal in samples), memory)
        taken[k] = time.perf_counter_ns() - begin
    late = np.mean(taken > 1e9 * run.period * SECONDS.get(run.time_unit, np.inf))
    return (*(np.percentile(taken, (50, 99, 100)) / 1e3).tolist(), float(late))
