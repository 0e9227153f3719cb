"""Runs several controllers on one problem, pairs them, and judges the effect of adaptation."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np

from fpirhc.contraction.spectrum import assess_gain
from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import checked
from fpirhc.controllers.contract import resolved
from fpirhc.deformation.base import automatic, innermost
from fpirhc.errors import FpirhcError, Mistakes, NotContractive
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed
from fpirhc.optimisers.base import FEASIBLE
from fpirhc.plant.motion import with_space
from fpirhc.problem_files.pairs import pair_of, same_as
from fpirhc.problem_files.problem_file import Task
from fpirhc.review.questions.gain import recommended_for
from fpirhc.review.response_prediction import Prediction, predict_response
from fpirhc.simulation.changes import Changes
from fpirhc.simulation.lyapunov_view import lyapunov_view
from fpirhc.simulation.metrics import Metrics, measure
from fpirhc.simulation.metrics.entries.contraction import sampled_spectrum
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import ComposedLoop, judged_run
from fpirhc.simulation.stepper import ComposedStep, Stepper
from fpirhc.simulation.trials import weighed
from fpirhc.studies.comparison.causes import yardstick_of
from fpirhc.studies.comparison.changes import Finding, Outcome, scales
from fpirhc.studies.comparison.comparison import Comparison
from fpirhc.studies.comparison.entry import Contraction, Entry, has_exact_model, information, lines_of, plan_every
from fpirhc.studies.comparison.optimality import Optimality, measure_optimality
from fpirhc.studies.comparison.pairwise import (
    Built,
    NullTest,
    beside_each_other,
    null_tests,
    partners,
    with_reviewed_causes,
)
from fpirhc.studies.comparison.timing import measure_cycles, step_to_time
from fpirhc.studies.comparison.verdict import findings
from fpirhc.studies.objective import Objective, objective
from fpirhc.studies.view import Progress, circumstances
from fpirhc.symbolic.evaluate import attempted
from fpirhc.symbolic.native import compiling_ahead
from fpirhc.task.problem import Problem


def select(task: Task, names: Sequence[str] | None) -> dict[str, Controller]:
    """Return the named controllers of a task in the given order; all of them when no names are given."""
    if not names:
        return dict(task.controllers)
    mistakes = Mistakes(f"problem '{task.name}'")
    mistakes.unknown("controller", names, task.controllers)
    if not mistakes.none and any("," in name for name in names):
        mistakes.add("names are separated by spaces, without commas")
    mistakes.raise_if_any()
    return {name: task.controllers[name] for name in names}


@checked_call
def compare(
    task: Task,
    *,
    seed: Seed,
    controllers: Sequence[str] | None = None,
    headline: str | None = None,
    compiled: bool | None = True,
    command: str = "",
    progress: Progress | None = None,
    changes: Mapping[str, Changes] | None = None,
) -> Comparison:
    """Run the task's controllers with the same disturbances and return their results.

    A controller that cannot serve the problem is skipped with its reason. Ctrl-C keeps the finished runs.

    Args:
        task: the loaded problem file.
        seed: of the disturbances and the noise.
        controllers: names of controllers; None: all.
        headline: number of which the verdict speaks first, 'in_band' or 'rms_error.q1'; None: the problem's, or errors alone.
        compiled: whether runs use compiled C; None: unless they are short.
        command: the command line, for the report.
        progress: function of (controller, cycles done, cycles in all).
        changes: numbers of settings from a time on, by time in s, by controller.

    Raises:
        InvalidName, InvalidValue: an unknown headline, or one without a better direction.
        InvalidProblem: unknown controllers, or deformations with a gain of the wrong sign.
    """
    begin = time.perf_counter()
    figure = objective(task.headline_metric if headline is None else headline, task.metrics, task.problem)
    selected = select(task, controllers)
    mistakes = Mistakes("changes")
    mistakes.unknown("controller", changes or (), selected)
    mistakes.raise_if_any()
    check_gains(task, selected)
    built: dict[str, Built] = {}
    ran, skipped = _entries(task, selected, seed, compiled, progress, built, changes or {})
    _check_figure(figure, ran)
    sizes = scales(task.problem)
    found, unjudged = partners(task.problem, ran, selected, seed=seed, compiled=compiled, metrics=task.metrics)
    alone = [entry for entry, _ in found.values()]
    ran = [replace(e, pair=found[e.name][0].name) if e.name in found else e for e in ran]
    broken: list[str] = []
    ran = _timed(task.problem, ran, built, broken)
    entries = beside_each_other(task.problem, ran, built, sizes)
    built |= {entry.name: Built(loop, None) for entry, loop in found.values()}
    judge = partial(
        findings,
        skipped=skipped,
        headline=task.headline,
        yardstick=yardstick_of(task.problem, seed=seed),
        partners=alone,
        unjudged=unjudged,
        figure=figure,
    )
    entries = with_reviewed_causes(task.problem, entries, built, judge(entries))
    judged = judge(entries)
    pairs = list(dict.fromkeys(finding.pair for finding in judged if finding.pair))
    nulls = null_tests(task.problem, pairs, [*entries, *alone], built, sizes, seed=seed, broken=broken)
    facts = circumstances(task, {}, command, begin)
    facts["settings"] |= {e.name: {k: v for k, v in e.run.settings.items() if k != "problem"} for e in entries}
    return Comparison(
        **facts,
        seed=seed,
        measure_from=task.problem.measure_from,
        entries=tuple(_advised(task, entries, judged[0], nulls)),
        skipped=skipped,
        findings=judged,
        pictures=task.pictures,
        nulls=nulls,
        time_unit=task.problem.time_unit,
        steps=task.problem.real_integrator.steps_maps,
        information=(*lines_of(task.problem, {e.name: e.information for e in entries if e.information}), *broken),
    )


def _advised(task: Task, entries: Sequence[Entry], first: Finding, nulls: Sequence[NullTest]) -> list[Entry]:
    """The entries; the adaptive one of the first pair with the recommended gain, where it does not help and fails no null test."""
    failed = any(test.harmful for test in nulls if test.pair == first.pair)
    adaptive = next((e for e in entries if first.pair and e.name == first.pair[1]), None)
    said = adaptive is None or bool(adaptive.reviewed_gain)
    if first.pair is None or failed or said or first.outcome not in (Outcome.WORSE, Outcome.MIXED, Outcome.DOUBTFUL):
        return list(entries)
    advice = recommended_for(task.problem, task.controllers[first.pair[1]])
    more = () if advice is None else (f"its gain: {advice.text}",)
    return [replace(e, notes=(*e.notes, *more)) if e.name == first.pair[1] else e for e in entries]


def _check_figure(figure: Objective, entries: Sequence[Entry]) -> None:
    """Raise where runs finished and none has the figure, unless its function raised, which the notes tell."""
    metric, finished = figure.metric, [e for e in entries if e.run.stop is None]
    if metric is None or any(
        figure.element in e.metrics[metric.name] or metric.name in e.metrics.broken for e in finished
    ):
        return
    for entry in finished[-1:]:
        figure.check(entry.name, entry.metrics[metric.name])


def check_gains(task: Task, controllers: Mapping[str, Controller]) -> None:
    """Raise for gains of the wrong sign, which are mistakes in the file and no results, before anything runs."""
    mistakes = Mistakes(f"problem '{task.name}'")
    for name, controller in controllers.items():
        try:
            checked(task.problem, controller)
        except NotContractive as error:
            advice = recommended_for(task.problem, controller)
            mistakes.add(f"controller '{name}': {error if advice is None else error.advised(advice.text)}")
        except FpirhcError:
            continue  # reported later, as the reason why the controller is skipped
    mistakes.raise_if_any()


_CYCLE = "the time of a cycle"


def _entries(
    task: Task,
    controllers: Mapping[str, Controller],
    seed: int,
    compiled: bool | None,
    progress: Progress | None,
    built: dict[str, Built],
    changes: Mapping[str, Changes],
) -> tuple[list[Entry], dict[str, str]]:
    """Entries of the controllers that ran, and reasons why the others were skipped; what ran is added to `built`.

    All are composed before the first one runs, so that their compilers are at work side by side.
    """
    entries: list[Entry] = []
    skipped: dict[str, str] = {}
    composed: dict[str, _Composed] = {}
    try:
        with compiling_ahead() as begin:
            for name, controller in controllers.items():
                with _skipping(name, skipped):
                    composed[name] = _composed(task.problem, name, controller, changes.get(name, {}), progress)
                    composed[name].begin(begin, compiled)
            for name, one in composed.items():
                with _skipping(name, skipped):
                    entries.append(_entry(task, controllers, name, one, seed, compiled, progress, built))
    except KeyboardInterrupt:
        done = {*skipped, *(e.name for e in entries)}
        skipped |= {name: "interrupted before it finished" for name in controllers if name not in done}
    return entries, {name: skipped[name] for name in controllers if name in skipped}


@contextmanager
def _skipping(name: str, skipped: dict[str, str]) -> Iterator[None]:
    """Note why a controller is skipped, and go on."""
    try:
        yield
    except FpirhcError as error:
        skipped[name] = str(error)


@dataclass(frozen=True, eq=False)
class _Composed:
    """A controller before its compilers have ended: its loop, and the step by hand, None where that is broken."""

    ready: Controller
    loop: ComposedLoop
    by_hand: ComposedStep | None
    changes: Changes
    broken: tuple[str, ...]

    def begin(self, begin: Callable[..., None], compiled: bool | None) -> None:
        """Start the compilers of both."""
        if self.loop.worth_compiling(compiled):
            begin(self.loop.function, calls=self.loop.calls)
            if self.by_hand is not None:
                begin(self.by_hand.function)


def _composed(
    problem: Problem, name: str, controller: Controller, changes: Changes, progress: Progress | None
) -> _Composed:
    if progress:
        progress(name, 0, problem.cycles)
    broken: list[str] = []
    ready = resolved(problem, controller)
    live = tuple(dict.fromkeys(path for numbers in changes.values() for path in numbers))
    loop = ComposedLoop.of(problem, ready, live)
    step = attempted(_CYCLE, step_to_time, problem, ready, broken=broken)
    return _Composed(ready, loop, step, changes, tuple(broken))


def _entry(
    task: Task,
    controllers: Mapping[str, Controller],
    name: str,
    composed: _Composed,
    seed: int,
    compiled: bool | None,
    progress: Progress | None,
    built: dict[str, Built],
) -> Entry:
    problem, controller, ready = task.problem, controllers[name], composed.ready
    report = progress and partial(progress, name)
    if report:
        report(0, problem.cycles)
    loop = composed.loop.simulator(compiled)
    compiled = loop.compiled if compiled is None else compiled
    run = judged_run(loop, seed=seed, name=name, progress=report, changes=composed.changes)
    adaptive, every = ready.deformation.adapts, plan_every(problem, ready)
    broken = [*cast(Sequence[str], run.settings.get("broken", ())), *composed.broken]
    part = partial(attempted, broken=broken)
    metrics = measure(problem, run, task.metrics)
    view = part("the Lyapunov function", lyapunov_view, problem, ready, run)
    stepper = part(_CYCLE, Stepper.of, composed.by_hand, compiled=compiled) if composed.by_hand else None
    built[name], told = Built(loop, stepper), [view.text] if view else []
    contraction = part("the contraction", _contraction, problem, ready, run, metrics)
    optimality = part("the excess cost of the plans", measure_optimality, problem, ready, run, compiled=compiled)
    predicts = adaptive and name in (task.headline or ())
    prediction = part("the prediction", _predicted, problem, controller, compiled) if predicts else None
    informed = part("the sentence about what it measures", information, problem, ready, loop.loop, every)
    return Entry(
        name=name,
        run=run,
        metrics=metrics,
        cycle=None,  # measured when all have run, in turn
        adaptive=adaptive,
        pair=pair_of(controllers, name) if adaptive else None,
        contraction=contraction,
        optimality=optimality,
        notes=(
            *broken_limits(problem, run),
            *_notes(controller, ready),
            *ready.notes(problem),
            *told,
            *_remarks(run, optimality),
            *broken,
            *metrics.broken.values(),
        ),
        lyapunov=view,
        prediction=prediction,
        weighed=weighed(problem, ready),
        exact=has_exact_model(problem, ready),
        learns=ready.learns,
        fixed=same_as(controller.inner, controllers) if ready.learns and controller.inner is not None else None,
        plan_every=every,
        information=informed,
        automatic=automatic(controller.deformation),
    )


def _timed(problem: Problem, entries: Sequence[Entry], built: Mapping[str, Built], broken: list[str]) -> list[Entry]:
    """The entries with the times of their cycles, which are measured in turn."""
    ran = {e.name: (stepper, e.run) for e in entries if (stepper := built[e.name].stepper) is not None}
    times = attempted(_CYCLE, measure_cycles, problem, [*ran.values()], broken=broken)
    of = dict(zip(ran, times or (), strict=False))
    return [replace(e, cycle=of.get(e.name)) for e in entries]


def _remarks(run: Run, optimality: Optimality | None) -> list[str]:
    """What a reader should know of a run; plans at their optimum, to the accuracy of costs, depend on rounding no more than it."""
    reached = optimality is not None and optimality.reached
    return [text for text in run.remarks if not (reached and text == run.depends_on_rounding)]


def _predicted(problem: Problem, controller: Controller, compiled: bool) -> Prediction | None:
    """The prediction before the run; None where no prediction covers the controller."""
    try:
        return predict_response(problem, controller, compiled=compiled)
    except FpirhcError:
        return None


def _contraction(problem: Problem, controller: Controller, run: Run, metrics: Metrics) -> Contraction | None:
    """The measured contraction with its explanation; None where none was measured."""
    predicted = metrics.values.get("contraction.predicted")
    if not predicted:
        return None
    spectrum, measured = sampled_spectrum(problem, run), metrics["contraction.measured"][""]
    growing = metrics["contraction.growing"][""]
    return Contraction(predicted[""], growing, measured, assess_gain(controller.deformation, spectrum), spectrum)


_CLOSE = 1e-3  # share of half the range of its limits, or of the only one, within which a state keeps it


def broken_limits(problem: Problem, run: Run) -> tuple[str, ...]:
    """By how much the run leaves each hard limit of a state."""
    limits, names, units = problem.limits, problem.plant.state.elements, problem.plant.state.units
    hard = [k for k, name in enumerate(names) if name in limits.states and name not in {**limits.soft, **limits.prices}]
    texts = []
    for k in hard:
        (low, high), values = limits.states[names[k]], run["plant_state"][:, k]
        half, small = 0.5 * (high - low), min(FEASIBLE, _CLOSE * float(np.abs(values).max()))
        for beyond, limit, end in ((values.max() - high, high, values.max()), (low - values.min(), low, values.min())):
            if beyond > (_CLOSE * half if math.isfinite(half) else max(small, _CLOSE * abs(limit))):
                unit = with_space(units[k])
                texts.append(f"{names[k]} reaches {end:.4g}{unit}, beyond its hard limit of {limit:g}{unit}")
    return tuple(texts)


def _notes(controller: Controller, ready: Controller) -> tuple[str, ...]:
    """Which settings of the deformation were chosen automatically."""
    map_ = innermost(ready.deformation)
    return tuple(
        f"{name} = {getattr(map_, name):g} was chosen automatically" for name in automatic(controller.deformation)
    )
