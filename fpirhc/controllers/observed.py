"""Which errors of believed states no measurement corrects, along the reference, and whether they decay by themselves.

The model is linearised at instants of the reference, with the inputs that it needs there. States count in units of their size along
the reference, so that a unit does not decide what can be seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.controllers.observed_state import sample_path
from fpirhc.controllers.reference_states import nominal_motion
from fpirhc.errors import NotSupported
from fpirhc.horizon.nominal import known_on_reference, nominal_run, reference_state
from fpirhc.plant.maps import growth_of
from fpirhc.sensing.base import values_of
from fpirhc.sensing.observability import members, slowest
from fpirhc.task.exogenous import known_places
from fpirhc.task.problem import Problem, nominal_start

_INSTANTS = 25
_STAYS = 1e-9  # share of the fastest pole below which an error counts as staying


@dataclass(frozen=True)
class FreeErrors:
    """Errors of believed states that no measurement corrects.

    Args:
        states: names of the states that have a part in them.
        pole: largest real part of their poles along the reference, 1 / unit of time; negative: all decay.
        decays: whether they decay by themselves.
    """

    states: tuple[str, ...]
    pole: float
    decays: bool


@lru_cache(maxsize=8)  # several controllers are checked on one problem
def free_errors(problem: Problem) -> FreeErrors:
    """Return the errors of the believed states that no measurement corrects; of a problem without an observer there are none."""
    plant, observer = problem.plant, problem.sensing.observer
    if observer is None:
        return FreeErrors((), -np.inf, decays=True)
    names = observer.uses(problem.sensing.measures(plant))
    states, slopes, shown = _linearised(problem, names)
    size = np.maximum(np.abs(states).max(axis=0), np.abs(problem.start_state))
    size[size == 0] = 1.0
    known = [plant.state.elements.index(e) for e in problem.sensing.known(plant)]
    scaled = [a * size / size[:, None] for a in slopes]
    basis = observer.free(scaled, [c * size for c in shown], known)
    pole = slowest(scaled, basis, growth_of(plant))
    fastest = max(float(np.abs(np.linalg.eigvals(a)).max()) for a in slopes)
    return FreeErrors(tuple(plant.state.elements[k] for k in members(basis)), pole, decays=pole < -_STAYS * fastest)


def check_observed(problem: Problem) -> None:
    """Raise if errors are neither observed nor decay, and the observer cannot bear that.

    Raises:
        NotSupported: with the states, and what would help.
    """
    observer = problem.sensing.observer
    if observer is None or not observer.needs_detectability:
        return
    free = free_errors(problem)
    if not free.decays:
        measured = ", ".join(observer.uses(problem.sensing.measures(problem.plant)))
        raise NotSupported(
            f"{type(observer).__name__}: {' and '.join(free.states)} cannot be observed along the reference from {measured}, and "
            f"an error of what is believed does not decay (pole {free.pole:.3g} {problem.rate_unit}); measure {free.states[0]}, or "
            "another quantity that depends on it; ModelStates() believes the model alone"
        )


def check_believed(problem: Problem, controller: Controller) -> None:
    """Raise if a controller cannot be given believed states, or the observer cannot be right.

    Raises:
        NotSupported: an adaptive controller whose response nobody measures; a measurement that is late by a fraction of a cycle
            beside signals from outside; a model with other parameters than the problem's; errors that are neither observed nor
            decay.
    """
    sensing, plant = problem.sensing, problem.plant
    if sensing.observer is None:
        return
    lost = sensing.believed_response(plant)
    if lost and controller.deformation.adapts:
        raise NotSupported(
            f"the response that {type(controller.deformation).__name__} compares needs {', '.join(lost)}, which no sensor shows: "
            "the model's own response is the request, from which nothing can be learned. Measure it, or choose an estimator of "
            f"what is measured ({', '.join(sensing.measures(plant))})"
        )
    _check_late(problem)
    model = controller.plant_model(problem).plant
    if model.parameter.elements != plant.parameter.elements:
        raise NotSupported(
            f"{type(controller).__name__} has a model with other parameters than the problem's, and states are believed by the "
            "problem's; leave the observer out, or give both the same parameters"
        )
    check_observed(problem)


def _check_late(problem: Problem) -> None:
    """Raise where the signals of the time of the samples are not known."""
    if sample_path(problem).fraction and known_places(problem.plant, problem.signals):
        late, unit = problem.dead_time.measurement, problem.time_unit
        raise NotSupported(
            f"believed states beside signals from outside need a measurement that is late by whole cycles, and {late:g} {unit} are "
            f"{late / problem.period:.4g} cycles; use {sample_path(problem).late * problem.period:g} {unit}"
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
        raise NotSupported("believed states: the model has no finite Jacobian along the reference")
    return np.array(states), slopes, seen


def _points(problem: Problem) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """States and inputs of the model along the reference, or of a simulation where it does not give the states."""
    plant = problem.plant
    if known_on_reference(plant):
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
