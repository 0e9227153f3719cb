"""Which errors of believed states no measurement corrects, along the reference, and whether they decay by themselves.

The model is linearised at instants of the reference, with the inputs that it needs there. States count in units of their size along
the reference, so that a unit does not decide what can be seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from fpirhc.errors import NotSupported
from fpirhc.plant.maps import growth_of
from fpirhc.sensing.beliefs.kalman_filter import shown_by
from fpirhc.sensing.observability import members, slowest
from fpirhc.task.problem import Problem

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
    """Return the errors of the believed states that no measurement corrects; of a problem without a belief there are none."""
    plant, belief = problem.plant, problem.sensing.belief
    if belief is None:
        return FreeErrors((), -np.inf, decays=True)
    names = belief.uses(problem.sensing.measures(plant))
    states, slopes, shown = _linearised(problem, names)
    size = np.maximum(np.abs(states).max(axis=0), np.abs(problem.start_state))
    size[size == 0] = 1.0
    known = [plant.state.elements.index(e) for e in problem.sensing.known(plant)]
    scaled = [a * size / size[:, None] for a in slopes]
    basis = belief.free(scaled, [c * size for c in shown], known)
    pole = slowest(scaled, basis, growth_of(plant))
    fastest = max(float(np.abs(np.linalg.eigvals(a)).max()) for a in slopes)
    return FreeErrors(tuple(plant.state.elements[k] for k in members(basis)), pole, decays=pole < -_STAYS * fastest)


def check_observed(problem: Problem) -> None:
    """Raise if errors are neither observed nor decay, and the belief cannot bear that.

    Raises:
        NotSupported: with the states, and what would help.
    """
    belief = problem.sensing.belief
    if belief is None or not belief.must_decay:
        return
    free = free_errors(problem)
    if not free.decays:
        measured = ", ".join(belief.uses(problem.sensing.measures(problem.plant)))
        raise NotSupported(
            f"{type(belief).__name__}: {' and '.join(free.states)} cannot be observed along the reference from {measured}, and an "
            f"error of what is believed does not decay (pole {free.pole:.3g} {problem.rate_unit}); measure {free.states[0]}, or "
            "another quantity that depends on it; ModelStates() believes the model alone"
        )


def _linearised(problem: Problem, names: tuple[str, ...]) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """States of the reference, shape (instants, nx), and there dx'/dx and the Jacobian of the measured quantities."""
    plant = problem.plant
    x, u, p = plant.symbols()
    shown = ca.vertcat(*shown_by(plant, names, x, u, p))
    rate = plant.derivative_function(x, u, p)
    jacobians = ca.Function("fpirhc_observed", [x, u, p], [ca.jacobian(rate, x), ca.jacobian(shown, x)])
    reference, states, slopes, seen = problem.reference.function(plant), [], [], []
    for t in np.linspace(0.0, problem.duration, _INSTANTS):
        state, response = reference(t)
        needed: ca.DM = ca.DM(problem.inputs_before)
        if len(plant.controlled_names) == len(plant.inputs):
            needed = plant.inverse_function(state, response[list(plant.controlled_indices)], plant.approximate)
        slope, part = (np.asarray(m.full()) for m in jacobians(state, needed, plant.approximate))
        if np.isfinite(slope).all() and np.isfinite(part).all():
            states.append(np.asarray(state.full()).ravel())
            slopes.append(slope)
            seen.append(part)
    if not slopes:
        raise NotSupported("believed states: the model has no finite Jacobian along the reference")
    return np.array(states), slopes, seen
