"""Which errors of believed states no measurement corrects; a controller is refused states that cannot be right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller, refuse
from fpirhc.controllers.reference_states import nominal_motion
from fpirhc.errors import NoAnswer
from fpirhc.horizon.nominal import nominal_run, reference_state
from fpirhc.plant.maps import growth_of
from fpirhc.sensing.base import members, slowest, unobservable, values_of
from fpirhc.task.problem import Problem, nominal_start

_INSTANTS = 25
_STAYS = 1e-9  # share of the fastest pole below which an error counts as staying


@dataclass(frozen=True)
class UnobservableErrors:
    """Errors of believed states that no measurement corrects."""

    states: tuple[str, ...]  # names of the states that have a part in them
    pole: float  # largest real part of their poles along the reference, 1 / unit of time; negative: all decay
    decays: bool  # whether they decay by themselves


@lru_cache(maxsize=8)  # several controllers are checked on one problem
def unobservable_errors(problem: Problem) -> UnobservableErrors:
    """Return the errors of the believed states that no measurement corrects; of a problem without an observer there are none."""
    plant, observer = problem.plant, problem.sensing.observer
    if observer is None:
        return UnobservableErrors((), -np.inf, decays=True)
    names = observer.uses(problem.sensing.measures(plant))
    states, slopes, shown = _linearised(problem, names)
    size = np.maximum(np.abs(states).max(axis=0), np.abs(problem.start_state))
    size[size == 0] = 1.0
    scaled = [a * size / size[:, None] for a in slopes]
    basis = unobservable(scaled, [c * size for c in shown])
    pole = slowest(scaled, basis, growth_of(plant))
    fastest = max(float(np.abs(np.linalg.eigvals(a)).max()) for a in slopes)
    return UnobservableErrors(
        tuple(plant.state.elements[k] for k in members(basis)), pole, decays=pole < -_STAYS * fastest
    )


def check_observed(problem: Problem) -> None:
    """Raise if errors are neither observed nor decay."""
    observer = problem.sensing.observer
    if observer is None:
        return
    free = unobservable_errors(problem)
    if not free.decays:
        measured = ", ".join(observer.uses(problem.sensing.measures(problem.plant)))
        raise NoAnswer(
            f"{type(observer).__name__}: {' and '.join(free.states)} cannot be observed along the reference from {measured}, and "
            f"an error of what is believed does not decay (pole {free.pole:.3g} {problem.rate_unit}); measure {free.states[0]}, or "
            "another quantity that depends on it"
        )


def check_believed(problem: Problem, controller: Controller) -> None:
    """Raise if a controller cannot be given believed states, or the observer cannot be right."""
    if problem.sensing.observer is not None:
        refuse(_against(problem, controller))
        check_observed(problem)


def _against(problem: Problem, controller: Controller) -> Iterator[str]:
    """Reasons against believed states."""
    sensing, plant = problem.sensing, problem.plant
    lost = sensing.believed_response(plant)
    if lost and controller.deformation.adapts:
        yield (
            f"the response that {type(controller.deformation).__name__} compares needs {', '.join(lost)}, which no sensor shows: "
            "the model's own response is the request, from which nothing can be learned. Measure it, or choose an estimator of "
            f"what is measured ({', '.join(sensing.measures(plant))})"
        )
    model = controller.plant_model(problem).plant
    if model.parameter.elements != plant.parameter.elements:
        yield (
            f"{type(controller).__name__} has a model with other parameters than the problem's, and states are believed by the "
            "problem's; leave the observer out, or give both the same parameters"
        )


def _linearised(problem: Problem, names: tuple[str, ...]) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """States of the reference, shape (instants, nx), and there dx'/dx and the Jacobian of the measured quantities."""
    plant = problem.plant
    x, u, p = plant.symbols()
    values = values_of(plant, x, u, p)
    shown = ca.vertcat(*(values[n] for n in names))
    rate = plant.equations.rate(x, u, p)
    jacobians = ca.Function("fpirhc_observed", [x, u, p], [ca.jacobian(rate, x), ca.jacobian(shown, x)])
    states, slopes, seen = [], [], []
    for state, needed in _points(problem):
        slope, part = (np.asarray(m.full()) for m in jacobians(state, needed, plant.approximate))
        if np.isfinite(slope).all() and np.isfinite(part).all():
            states.append(state)
            slopes.append(slope)
            seen.append(part)
    if not slopes:
        raise NoAnswer("believed states: the model has no finite Jacobian along the reference")
    return np.array(states), slopes, seen


def _points(problem: Problem) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """States and inputs of the model along the reference, or of a simulation where it does not give the states."""
    plant = problem.plant
    if plant.equations.known_on_reference:
        reference, needed = nominal_motion(problem), problem.inputs_before
        for t in np.linspace(0.0, problem.duration, _INSTANTS):
            outputs, response = reference(t)
            state = reference_state(plant, outputs)
            if len(plant.controlled_names) == len(plant.inputs):
                needed = np.asarray(plant.equations.inverse(state, response, plant.approximate).full())
            yield np.asarray(state.full()).ravel(), needed.ravel()
        return
    states, inputs = nominal_run(problem.plant, problem.reference, *nominal_start(problem))
    for k in np.unique(np.linspace(0, states.shape[1] - 1, _INSTANTS).astype(int)):
        yield states[:, k], inputs[:, k]
