"""Runs of a controller on its own model, so that every change by adaptation is harm; those without adaptation are made once.

There are no disturbances and no noise. Dead times and the estimator of the response are those of the problem; a lag that the
deformation believes is a part of the model, see `believed_way`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved, without_deformation
from fpirhc.describe import identity
from fpirhc.errors import FpirhcError
from fpirhc.plant.motion import followed_units
from fpirhc.review.grid import each
from fpirhc.review.prediction import NominalRun, exactly, nominal_of, nominal_run
from fpirhc.simulation.error_pair import ErrorPair
from fpirhc.simulation.metrics.entries.commands import at_limit
from fpirhc.simulation.model_as_plant import shortened, with_believed_way
from fpirhc.simulation.run import Run
from fpirhc.simulation.trials import Trials, loop_of
from fpirhc.symbolic.latest import Latest
from fpirhc.task.exogenous import as_known
from fpirhc.task.problem import Problem

CYCLES = 2000  # of a run
TRIED = 1000  # cycles of a run that tries a form or a gain
_ROUNDING = 1e-9  # of the reference's size

Kept = TypeVar("Kept")


@dataclass(frozen=True, eq=False)
class NominalRuns:
    """Runs of a problem's models without adaptation, each made when it is first asked for.

    Controllers that differ in their deformation alone share one.

    Args:
        problem: the problem; its runs are shortened to at most `CYCLES` cycles.
    """

    problem: Problem
    _known: dict[Hashable, object] = field(default_factory=dict, init=False)

    def of(self, controller: Controller) -> NominalRun | str:
        """Return the nominal run with the controller's deformation, or the reason why there is none."""
        try:
            bare = without_deformation(resolved(self.problem, controller))
        except FpirhcError as error:
            return str(error)
        run = self._once(("nominal", identity(bare)), lambda: self._nominal(controller))
        return run if isinstance(run, str) else replace(run, controller=controller)

    def bare(self, controller: Controller) -> Run:
        """Return the run of the controller without its deformation on its model.

        Raises:
            FpirhcError: every error that the controller raises about the problem.
        """
        bare = without_deformation(resolved(self.problem, controller))
        return self._once(("bare", identity(bare)), lambda: _run(self.problem, null_problem(self.problem, bare), bare))

    def trials(self, problem: Problem, controller: Controller) -> Trials:
        """Return runs of deformations beside the controller without its own, of at most `TRIED` cycles each.

        Args:
            problem: of the review, with its reality.
            controller: resolved.

        Raises:
            FpirhcError: every error that the controller raises about the problem.
        """
        bare = without_deformation(controller)
        return self._once(("trials", identity(bare)), lambda: Trials(problem, bare, cycles=TRIED, goes_on=True))

    def _once(self, name: Hashable, make: Callable[[], Kept]) -> Kept:
        """Return what `make` returns, made when this name is first asked for."""
        if name not in self._known:
            self._known[name] = make()
        return cast("Kept", self._known[name])

    def _nominal(self, controller: Controller) -> NominalRun | str:
        problem = shortened(self.problem, CYCLES)
        try:
            if problem.plant.outputs or not replace(problem.sensing, sensors={}).ideal:
                return nominal_run(problem, controller, compiled=False)
            return nominal_of(problem, controller, lambda: self.bare(controller))
        except FpirhcError as error:
            return str(error)


def null_runs(problem: Problem, controller: Controller, runs: NominalRuns | None = None) -> ErrorPair:
    """Return the errors of the controller on its own model, with and without adaptation, over at most `CYCLES` cycles.

    Args:
        problem: the problem.
        controller: the controller.
        runs: those without adaptation; None: they are made here.

    Raises:
        NotSupported: a controller without a deformation.
        FpirhcError: every error that the controller raises about the problem.
    """
    model = null_problem(problem, controller)
    believes_more = model.reality is not None or model.dead_time is not problem.dead_time
    bare = without_deformation(resolved(model, controller))
    plain = _run(problem, model, bare) if believes_more or runs is None else runs.bare(controller)
    without, ranges = _errors_along(model, plain["plant_state"]), _ranges(model, plain["plant_state"])
    run = _run(problem, model, controller)
    lost = dict.fromkeys(without, float("inf"))
    adapted = lost if run.stop is not None else _errors_along(model, run["plant_state"])
    stuck = min(at_limit(model, plain), at_limit(model, run))
    return ErrorPair(without, adapted, ranges, followed_units(model.plant), stuck)


def _run(problem: Problem, model: Problem, controller: Controller) -> Run:
    """The run of the model by the loop of the problem's plant, whose plans are built already."""
    own = model if model.reality is not None else replace(model, plant=problem.plant)
    return loop_of(own, controller).run(seed=0, variant=model)


def null_problem(problem: Problem, controller: Controller) -> Problem:
    """Return the problem whose plant is the controller's model, without disturbances and noise, shortened to `CYCLES` cycles."""
    ready = resolved(problem, controller)
    return _NULL.of((problem,), (identity(ready),), lambda: _null(problem, ready))


_NULL: Latest[Problem] = Latest(4)  # several questions ask for that of one controller


def _null(problem: Problem, ready: Controller) -> Problem:
    known = ready.plant_model(problem)
    plant = exactly(problem.plant, known.parameters(problem.plant))
    sensing = replace(problem.sensing, sensors={}) if problem.sensing.sensors else problem.sensing
    signals = as_known(problem.plant, known.signals)
    model = replace(problem.of_model, plant=plant, disturbances={}, sensing=sensing, signals=signals)
    return with_believed_way(shortened(model, CYCLES), ready.deformation)


def _errors_along(problem: Problem, states: np.ndarray) -> dict[str, float]:
    first = round(problem.measure_from / problem.period)
    places, states = _places(problem), _followed(problem, states)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = states[first:, places] - _reference(problem, len(states))[first:, places]
        sizes = np.sqrt(np.mean(errors**2, axis=0))
    return dict(zip(problem.judged_names, map(float, sizes), strict=True))


def _ranges(problem: Problem, states: np.ndarray) -> dict[str, float]:
    """Range of the reference or the largest error, whichever is larger; the reference's size where both are rounding."""
    places, states = _places(problem), _followed(problem, states)
    reference = _reference(problem, len(states))[:, places]
    sizes = np.maximum(np.ptp(reference, axis=0), np.abs(states[:, places] - reference).max(axis=0))
    largest = np.abs(reference).max(axis=0)
    sizes = np.where(sizes > _ROUNDING * largest, sizes, largest)
    return dict(zip(problem.judged_names, map(float, sizes), strict=True))


def _places(problem: Problem) -> list[int]:
    return [problem.plant.output.elements.index(n) for n in problem.judged_names]


def _followed(problem: Problem, states: np.ndarray) -> np.ndarray:
    """What follows the reference: the states, or the outputs and their derivatives, shape (m, ny)."""
    plant = problem.plant
    count = len(states)
    held = (np.zeros((count, plant.input.size)), np.tile(plant.exact, (count, 1)), np.zeros((count, len(plant.names))))
    return each(plant.equations.output, states, *held)


def _reference(problem: Problem, count: int) -> np.ndarray:
    """Reference states (count, nx) at the first cycles."""
    times = problem.period * np.arange(count)
    return np.asarray(problem.reference.function(problem.plant).map(count)(times[None, :])[0].full()).T
