"""The active limits of states of a plan, as equations in the inputs to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.optimisers.multipliers import sensitivity_of
from fpirhc.optimisers.plan import Plan

_RANK = 1e-9  # relative singular value below which active limits depend on each other


@dataclass(frozen=True, eq=False)
class Active:
    """Active limits of states.

    Args:
        rows: J, shape (count, N nu).
        distances: of the states beyond their limits, positive where violated, shape (count,).
        complementarity: largest product of a multiplier and the distance of its limit.
    """

    rows: np.ndarray
    distances: np.ndarray
    complementarity: float

    @property
    def count(self) -> int:
        """Number of active limits."""
        return self.rows.shape[0]


def active_limits(plan: Plan) -> Active:
    """Return the limits of states that have a multiplier at this plan."""
    ocp, multipliers = plan.problem, plan.state_multipliers
    has_multiplier = multipliers.ravel(order="F") != 0
    if not has_multiplier.any():
        return Active(np.zeros((0, plan.inputs.size)), np.zeros(0), 0.0)
    _, _, sensitivity = sensitivity_of(ocp)(plan.states[:, 0], plan.inputs, plan.data)
    limits = np.where(multipliers > 0, ocp.state_upper[:, None], ocp.state_lower[:, None]).ravel(order="F")[
        has_multiplier
    ]
    active = multipliers.ravel(order="F")[has_multiplier]
    beyond = np.sign(active) * (plan.states[:, 1:].ravel(order="F")[has_multiplier] - limits)
    products = np.abs(beyond * active)
    return Active(np.asarray(sensitivity.full())[has_multiplier], beyond, float(products.max()))


def directions(free: np.ndarray, active: Active) -> np.ndarray:
    """Return an orthonormal basis (N nu, k) of the moves of free inputs along which no active limit changes."""
    selected = np.eye(free.size)[:, free]
    if not active.count or not free.any():
        return selected
    _, sizes, turned = np.linalg.svd(active.rows[:, free])
    rank = int((sizes > _RANK * sizes.max()).sum())
    return np.asarray(selected @ turned[rank:].T)


def largest_return(active: Active, free: np.ndarray) -> float:
    """Return the largest entry of the shortest move of free inputs that puts the active limits right, to first order."""
    if not active.count or not free.any():
        return 0.0
    return float(np.abs(np.linalg.pinv(active.rows[:, free], rcond=_RANK) @ active.distances).max())
