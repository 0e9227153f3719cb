"""The null run: the model is its own plant, so that every change by adaptation is harm.

The controller runs on its model twice, with its deformation and without. There are no disturbances and no noise. Dead times and the
estimator of the response are those of the problem; a lag that the deformation believes is a part of the model, see `believed_way`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved, without_deformation
from fpirhc.review.grid import each
from fpirhc.review.nominal_runs import CYCLES
from fpirhc.review.prediction import NominalRun, exactly
from fpirhc.simulation.error_pair import ErrorPair
from fpirhc.simulation.model_as_plant import shortened, with_believed_way
from fpirhc.simulation.simulate import simulate
from fpirhc.task.exogenous import as_known
from fpirhc.task.problem import Problem

_ROUNDING = 1e-9  # of the reference's size


def null_runs(problem: Problem, controller: Controller, nominal: NominalRun | None = None) -> ErrorPair:
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
        states = run["plant_state"]
    else:
        states = nominal.states[:-1]
    without, ranges = _errors_along(model, states), _ranges(model, states)
    run = simulate(model, controller, seed=0, compiled=False)
    lost = dict.fromkeys(without, float("inf"))
    return ErrorPair(without, lost if run.stop is not None else _errors_along(model, run["plant_state"]), ranges)


def null_problem(problem: Problem, controller: Controller) -> Problem:
    """Return the problem whose plant is the controller's model, without disturbances and noise, shortened to `CYCLES` cycles."""
    ready = resolved(problem, controller)
    known = ready.plant_model(problem)
    plant = exactly(problem.plant, known.parameters(problem.plant))
    sensing = replace(problem.sensing, sensors={})
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
    if not plant.outputs:
        return states
    count = len(states)
    held = (np.zeros((count, plant.input.size)), np.tile(plant.exact, (count, 1)), np.zeros((count, len(plant.names))))
    return each(plant.equations.output, states, *held)


def _reference(problem: Problem, count: int) -> np.ndarray:
    """Reference states (count, nx) at the first cycles."""
    times = problem.period * np.arange(count)
    return np.asarray(problem.reference.function(problem.plant).map(count)(times[None, :])[0].full()).T
