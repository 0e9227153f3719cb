"""The units in which a plan with limits is measured, from the limits and the reference.

    inputs    half the range of the input, 1 where it is free
    states    half the range of the state's limits; without both, half the spread of the reference and a tenth of its size
    cost      C = median over the inputs of Q_uu (half range)^2, with Q_uu the curvature that is left along an input of the first
              stage once all later inputs answer it: without the answer it grows with every stage of an unstable model

gamma = unit^2 / C turns a gradient into a move, and 1e4 C / unit is the largest multiplier that a limit of a state may have, or its
price where it has one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.base import FEASIBLE, KEPT

_LEAST = 1e-3  # a smaller spread of the reference is no measure of a state
_CAPACITY = 1e4  # largest multiplier of a hard limit, in units of cost per unit
_NARROW = 1e-6  # limits closer together than this share of the reference's spread are an equation, not a range


@dataclass(frozen=True, eq=False)
class Scales:
    """Units of a problem.

    Args:
        inputs: shape (nu,).
        states: shape (ns,).
        cost: C.
        bounded: places of the states that have a limit.
        capacity: largest multipliers of the bounded states, in cost per unit.
        hard: whether the limits of the bounded states have no price.
    """

    inputs: np.ndarray
    states: np.ndarray
    cost: float
    bounded: tuple[int, ...]
    capacity: np.ndarray
    hard: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """Units of the entries that can be limited: the inputs, then the bounded states."""
        return np.concatenate([self.inputs, self.states[list(self.bounded)]])


def scales(ocp: OptimalControl) -> Scales:
    """Return the scales of a problem."""
    inputs = _half(ocp.input_lower, ocp.input_upper)
    inputs = np.where(np.isfinite(inputs) & (inputs > 0), inputs, 1.0)
    nodes = ocp.nodes[0]
    size = np.abs(nodes).max(axis=1)
    about = 0.5 * np.ptp(nodes, axis=1) + 0.1 * size
    about = np.where(about > 0, np.maximum(about, _LEAST), 1.0)
    range_ = _half(ocp.state_lower, ocp.state_upper)
    narrow = ~(np.isfinite(range_) & (range_ > _NARROW * about))
    cost = float(np.median(_answered_curvature(ocp) * inputs**2))
    places, states = (
        np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper)),
        np.where(narrow, about, range_),
    )
    hard = ocp.hard[places]
    capacity = np.where(hard, _CAPACITY * cost / states[places], ocp.state_price[places])
    return Scales(inputs, states, cost, tuple(int(k) for k in places), capacity, hard)


def tolerated(ocp: OptimalControl) -> np.ndarray:
    """Return the violation of every state's limits that still counts as kept, shape (ns,)."""
    half = _half(ocp.state_lower, ocp.state_upper)
    return np.where(np.isfinite(half) & (half > KEPT), np.minimum(FEASIBLE, KEPT * half), FEASIBLE)


def _answered_curvature(ocp: OptimalControl) -> np.ndarray:
    """Diagonal of Q_uu (nu,) of the first stage, by a Riccati sweep along the reference."""
    along = ocp.along
    value = along.final
    for a, b, q, s, r in zip(*(v[::-1] for v in (along.a, along.b, along.q, along.s, along.r)), strict=True):
        q_uu, cross = r + b.T @ value @ b, s + b.T @ value @ a
        value = q + a.T @ value @ a - cross.T @ np.linalg.lstsq(q_uu, cross, rcond=None)[0]
    diagonal = q_uu.diagonal()
    usable = np.isfinite(diagonal) & (diagonal > 0)
    return np.where(usable, diagonal, ocp.step * ocp.curvature)


def _half(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.asarray(0.5 * (upper - lower))
