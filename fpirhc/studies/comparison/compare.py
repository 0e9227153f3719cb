"""Runs several controllers on one problem, pairs them, and says what adaptation bought."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from fpirhc.contraction import ContractionReport, Spectrum, assess_gain
from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import checked, resolved, without_deformation
from fpirhc.deformation.base import innermost
from fpirhc.describe import describe
from fpirhc.errors import FpirhcError, InvalidName, Mistakes, NotContractive, NotSupported, nearest
from fpirhc.problem_files.problem_file import Task
from fpirhc.review.response_prediction import Prediction, predict_response
from fpirhc.simulation.lyapunov_view import LyapunovView, lyapunov_view
from fpirhc.simulation.metrics import Metrics, measure
from fpirhc.simulation.metrics.columns import columns
from fpirhc.simulation.metrics.entries.contraction import sampled_spectrum
from fpirhc.simulation.pictures.base import Picture
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.studies.comparison.optimality import Optimality, measure_optimality
from fpirhc.studies.comparison.timing import CycleTime, measure_cycle
from fpirhc.studies.comparison.verdict import verdict
from fpirhc.summary import line, number, table
from fpirhc.task.problem import Problem

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Contraction:
    """Contraction of one adaptive controller: predicted from the symbols along the run, measured from the run."""

    predicted: float
    measured: float
    report: ContractionReport
    spectrum: Spectrum


@dataclass(frozen=True, eq=False)
class Entry:
    """One controller's share of a comparison; `pair` names the same controller without adaptation, if present."""

    name: str
    run: Run
    metrics: Metrics
    cycle: CycleTime | None
    adaptive: bool
    pair: str | None
    contraction: Contraction | None
    optimality: Optimality | None = None
    notes: tuple[str, ...] = ()
    lyapunov: LyapunovView | None = None
    prediction: Prediction | None = None  # of the headline's adaptive controller, where there is one


@dataclass(frozen=True, eq=False)
class Comparison:
    """What `compare` found: entries in order, skipped controllers with the reason, the verdict in sentences."""

    problem: str
    title: str
    description: str
    seed: int
    measure_from: float
    entries: tuple[Entry, ...]
    skipped: Mapping[str, str]
    verdict: tuple[str, ...]
    command: str
    versions: Mapping[str, str]
    settings: Mapping[str, Any]
    elapsed: float
    pictures: tuple[Picture, ...] = ()

    def __repr__(self) -> str:
        counts = f"{len(self.entries)} controllers" + (f", {len(self.skipped)} skipped" if self.skipped else "")
        return line(self, self.problem, f"seed {self.seed}", counts, self.verdict[0])

    def _repr_html_(self) -> str:
        """Verdict and errors as a table, for notebooks."""
        shown = columns([e.metrics for e in self.entries], headline=True)
        rows = [
            (
                e.name,
                *(c.text(c.number(e.metrics), missing="", none="none") for c in shown),
                number(e.cycle.median) if e.cycle else "",
                f"ended early: {e.run.stop}" if e.run.stop else e.metrics.worst_status,
            )
            for e in self.entries
        ]
        head = ("controller", *(c.heading for c in shown), "cycle [us]", "worst status")
        return table(self.title, head, rows, self.verdict)

    def __getitem__(self, name: str) -> Entry:
        for entry in self.entries:
            if entry.name == name:
                return entry
        raise InvalidName(
            f"controller '{name}' is not in this comparison.{nearest(name, [e.name for e in self.entries])}"
        )


def select(task: Task, names: Sequence[str] | None) -> dict[str, Controller]:
    """Return the named controllers of a task in the given order; all of them when no names are given.

    Raises:
        InvalidProblem: unknown names, with the nearest valid ones.
    """
    if not names:
        return dict(task.controllers)
    mistakes = Mistakes(f"problem '{task.name}'")
    mistakes.unknown("controller", names, task.controllers)
    mistakes.raise_if_any()
    return {name: task.controllers[name] for name in names}


def compare(
    task: Task,
    *,
    seed: int,
    controllers: Sequence[str] | None = None,
    compiled: bool = True,
    command: str = "",
    progress: Progress | None = None,
) -> Comparison:
    """Run the task's controllers with the same disturbances and return what they achieved.

    A controller that cannot serve the problem is skipped with its reason. Ctrl-C keeps what is finished.

    Raises:
        InvalidProblem: unknown controllers, or deformations with a gain of the wrong sign.
    """
    begin = time.perf_counter()
    check_gains(task, select(task, controllers))
    chosen, skipped = select(task, controllers), {}
    entries: list[Entry] = []
    for name, controller in chosen.items():
        try:
            entries.append(_entry(task, chosen, name, controller, seed, compiled, progress))
        except FpirhcError as error:
            skipped[name] = str(error)
        except KeyboardInterrupt:
            waiting = list(chosen)[len(entries) + len(skipped) :]
            skipped |= dict.fromkeys(waiting, "interrupted before it finished")
            break
    return Comparison(
        problem=task.name,
        title=task.title,
        description=task.description,
        seed=seed,
        measure_from=task.problem.measure_from,
        entries=tuple(entries),
        skipped=skipped,
        verdict=verdict(entries, skipped, task.headline),
        command=command,
        versions=versions(),
        settings=describe(task.problem),
        elapsed=time.perf_counter() - begin,
        pictures=task.pictures,
    )


def check_gains(task: Task, chosen: Mapping[str, Controller]) -> None:
    """A gain of the wrong sign is a mistake in the file, not a result: it is refused before anything runs."""
    mistakes = Mistakes(f"problem '{task.name}'")
    for name, controller in chosen.items():
        try:
            checked(task.problem, controller)
        except NotContractive as error:
            mistakes.add(f"controller '{name}': {error}")
        except FpirhcError:
            continue  # said later, as the reason why the controller is skipped
    mistakes.raise_if_any()


def versions() -> dict[str, str]:
    """Versions of fpirhc and of what its numbers depend on."""
    import platform

    found = {name: version(name) for name in ("fpirhc", "casadi", "numpy", "scipy")}
    return {**found, "python": platform.python_version(), "machine": platform.machine()}


def _entry(
    task: Task,
    chosen: Mapping[str, Controller],
    name: str,
    controller: Controller,
    seed: int,
    compiled: bool,
    progress: Progress | None,
) -> Entry:
    problem = task.problem
    ready = resolved(problem, controller)

    def report(done: int, total: int) -> None:
        if progress:
            progress(name, done, total)

    report(0, problem.cycles)
    run = simulate(problem, ready, seed=seed, name=name, compiled=compiled, progress=report)
    adaptive = ready.deformation.adapts
    view = lyapunov_view(problem, ready, run)
    metrics = measure(problem, run, task.metrics)
    return Entry(
        name=name,
        run=run,
        metrics=metrics,
        cycle=measure_cycle(problem, ready, run, compiled=compiled),
        adaptive=adaptive,
        pair=_pair(chosen, name) if adaptive else None,
        contraction=_contraction(problem, ready, run, metrics),
        optimality=measure_optimality(problem, ready, run, compiled=compiled),
        notes=(*_notes(controller, ready), *ready.notes(problem), *([view.text] if view else [])),
        lyapunov=view,
        prediction=_predicted(problem, controller, compiled) if adaptive and name in (task.headline or ()) else None,
    )


def _predicted(problem: Problem, controller: Controller, compiled: bool) -> Prediction | None:
    """What could have been known before the run; None where the prediction does not cover it."""
    try:
        return predict_response(problem, controller, compiled=compiled)
    except FpirhcError:
        return None


def _pair(chosen: Mapping[str, Controller], name: str) -> str | None:
    """The controller with the same settings and no adaptation."""
    try:
        wanted = describe(without_deformation(chosen[name]))
    except NotSupported:
        return None
    others = ((n, c) for n, c in chosen.items() if not c.deformation.adapts)
    return next((other for other, controller in others if describe(controller) == wanted), None)


def _contraction(problem: Problem, controller: Controller, run: Run, metrics: Metrics) -> Contraction | None:
    """What stands behind the contraction that was measured; None where none was."""
    predicted = metrics.values.get("contraction.predicted")
    if not predicted:
        return None
    spectrum, measured = sampled_spectrum(problem, run), metrics["contraction.measured"][""]
    return Contraction(predicted[""], measured, assess_gain(controller.deformation, spectrum), spectrum)


def _notes(asked: Controller, ready: Controller) -> tuple[str, ...]:
    """Which settings of the deformation were chosen automatically."""
    chosen = innermost(ready.deformation)
    return tuple(f"{name} = {getattr(chosen, name):g} was chosen automatically" for name in asked.deformation.automatic)
