"""The null run: the model is its own plant, so that every change by adaptation is harm.

The controller runs on its model twice, with its deformation and without. There are no disturbances and no noise. Dead times and the
estimator of the response are those of the problem.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved, without_deformation
from fpirhc.review.grid import each
from fpirhc.review.nominal_runs import CYCLES, shortened
from fpirhc.review.prediction import NominalRun, exactly
from fpirhc.simulation.simulate import simulate
from fpirhc.task.outside import as_told
from fpirhc.task.problem import Problem

WORSE, MUCH_WORSE, FAR_WORSE = 1.2, 2.0, 10.0  # ratio of the errors
_ROUNDING = 1e-9  # of the reference's size
SLIGHT, CLEAR = 1e-3, 1e-2  # added error as a share of the coordinate's range


@dataclass(frozen=True, eq=False)
class NullRuns:
    """Errors of the two runs on the right model.

    Args:
        without: rms tracking error by judged coordinate without adaptation, in the unit of the coordinate.
        adapted: the same with the deformation; infinite where the run ended early.
        ranges: range of the reference, or the largest error without adaptation where that is larger, by coordinate.
    """

    without: Mapping[str, float]
    adapted: Mapping[str, float]
    ranges: Mapping[str, float]

    @property
    def worst(self) -> str:
        """The coordinate to which adaptation adds the largest share of its range."""
        return max(self.without, key=self.added)

    def added(self, name: str) -> float:
        """The error that adaptation adds, as a share of the range of the coordinate."""
        return (self.adapted[name] - self.without[name]) / max(self.ranges[name], 1e-300)

    def ratio(self, name: str) -> float:
        """The error with adaptation over the error without."""
        return self.adapted[name] / max(self.without[name], 1e-300)

    @property
    def text(self) -> str:
        """Both errors of the worst coordinate in a sentence."""
        name = self.worst
        return (
            f"run on its own model, rms error of {name} {self.without[name]:.3g} without adaptation and {self.adapted[name]:.3g} "
            f"with it, {100 * self.added(name):+.2g} % of its range"
        )

    @property
    def passes(self) -> bool:
        """Whether adaptation makes no coordinate worse by more than a fifth and by a thousandth of its range."""
        return not self._beyond(WORSE, SLIGHT)

    @property
    def fails(self) -> bool:
        """Whether it makes one worse by a factor of two and a hundredth of its range, or by ten times and a thousandth."""
        return self._beyond(MUCH_WORSE, CLEAR) or self._beyond(FAR_WORSE, SLIGHT)

    def _beyond(self, ratio: float, share: float) -> bool:
        return any(not (self.ratio(n) <= ratio or self.added(n) <= share) for n in self.without)


def null_runs(problem: Problem, controller: Controller, nominal: NominalRun | None = None) -> NullRuns:
    """Return the errors of the controller on its own model, with and without adaptation, over at most `CYCLES` cycles.

    Args:
        problem: the problem.
        controller: the controller.
        nominal: the run without adaptation, if it is known.

    Raises:
        NotSupported: a controller without a deformation.
        FpirhcError: every error that the controller raises about the problem.
    """
    model = null_problem(problem, controller)
    if nominal is None:
        run = simulate(model, without_deformation(resolved(model, controller)), seed=0, compiled=False)
        states = run["state"]
    else:
        states = nominal.states[:-1]
    without, ranges = _errors_along(model, states), _ranges(model, states)
    return with_form(NullRuns(without, without, ranges), model, controller)


def with_form(runs: NullRuns, model: Problem, controller: Controller) -> NullRuns:
    """Return the runs with the errors of another controller in place of the adapted one; `model` is the null problem.

    Raises:
        FpirhcError: every error that the controller raises about the problem.
    """
    run = simulate(model, controller, seed=0, compiled=False)
    lost = dict.fromkeys(runs.without, float("inf"))
    return replace(runs, adapted=lost if run.stop is not None else _errors_along(model, run["state"]))


def null_problem(problem: Problem, controller: Controller) -> Problem:
    """Return the problem whose plant is the controller's model, without disturbances and noise, shortened to `CYCLES` cycles."""
    ready = resolved(problem, controller)
    plant = exactly(problem.plant, ready.parameters(problem.plant))
    sensing = replace(problem.sensing, sensors={})
    signals = as_told(problem.plant, ready.told(problem))
    model = replace(problem.of_model, plant=plant, disturbances={}, sensing=sensing, signals=signals)
    return shortened(model, CYCLES)


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
    if not plant.outputs:
        return states
    count = len(states)
    held = (np.zeros((count, plant.input.size)), np.tile(plant.exact, (count, 1)), np.zeros((count, len(plant.names))))
    return each(plant.output_function, states, *held)


def _reference(problem: Problem, count: int) -> np.ndarray:
    """Reference states (count, nx) at the first cycles."""
    times = problem.period * np.arange(count)
    return np.asarray(problem.reference.function(problem.plant).map(count)(times[None, :])[0].full()).T
