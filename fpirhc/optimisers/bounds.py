"""The units of a problem with limits of states: what plans measure distances, multipliers and costs in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.horizon.problem import OptimalControl, answered_curvature
from fpirhc.optimisers.base import KEPT, state_units

_CAPACITY = 1e4  # largest multiplier of a hard limit, in units of cost per unit


@dataclass(frozen=True, eq=False)
class Scales:
    """Units of a problem."""

    inputs: np.ndarray  # shape (nu,)
    states: np.ndarray  # shape (ns,)
    cost: float  # C
    bounded: tuple[int, ...]  # places of the states that have a limit
    capacity: np.ndarray  # largest multipliers of the bounded states, in cost per unit
    hard: np.ndarray  # whether the limits of the bounded states have no price

    @property
    def rows(self) -> np.ndarray:
        """Units of the entries that can be limited: the inputs, then the bounded states."""
        return np.concatenate([self.inputs, self.states[list(self.bounded)]])


def scales(ocp: OptimalControl) -> Scales:
    """Return the scales of a problem, from its limits and its reference.

        inputs    half the range of the input; where it is free, the least move along the reference that shifts a limited state
                  by its unit, which is 1 for an input that shifts none
        states    half the range of the state's limits; without both, or where they are an equation, half the spread
                  of the reference and a tenth of its size
        cost      C = median over the inputs of Q_uu (half range)^2, with Q_uu the curvature that is left along an input of the
                  first stage once all later inputs answer it: without the answer it grows with every stage of an unstable model

    gamma = unit^2 / C turns a gradient into a move, and 1e4 C / unit is the largest multiplier that a limit of a state may have.
    """
    states = state_units(ocp)
    places = np.flatnonzero(np.isfinite(ocp.state_lower) | np.isfinite(ocp.state_upper))
    inputs = _input_units(ocp, states, places)
    cost = float(np.median(_answered_curvature(ocp) * inputs**2))
    hard = ocp.hard[places]
    capacity = np.where(hard, _CAPACITY * cost / states[places], ocp.state_price[places])
    return Scales(inputs, states, cost, tuple(int(k) for k in places), capacity, hard)


def tolerated(ocp: OptimalControl) -> np.ndarray:
    """Return the violation of every state's limits that still counts as kept, shape (ns,)."""
    return KEPT * state_units(ocp)


def _input_units(ocp: OptimalControl, states: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The units of the inputs (nu,), with those of the states (ns,), of which some are limited at these places."""
    half = _half(ocp.input_lower, ocp.input_upper)
    free = ~np.isfinite(half)
    units = np.where(~free & (half > 0), half, 1.0)
    if not free.any() or not places.size:
        return units
    # A force of 1 N is nothing to a car: limits that a plan can keep were given up.
    slopes = np.abs(ocp.along.sensitivity()[:, places]).reshape(ocp.stages, places.size, ocp.stages, ocp.input.size)
    with np.errstate(divide="ignore", invalid="ignore"):
        moves = (states[places, None] / slopes.max(axis=(0, 2))).min(axis=0)
    return np.where(free & np.isfinite(moves) & (moves > 0), moves, units)


def _answered_curvature(ocp: OptimalControl) -> np.ndarray:
    """The curvature (nu,) along the inputs of the first stage once later inputs answer; that of later inputs at rest else."""
    diagonal = answered_curvature(ocp.along)
    usable = np.isfinite(diagonal) & (diagonal > 0)
    return np.where(usable, diagonal, ocp.step * ocp.curvature)


def _half(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.asarray(0.5 * (upper - lower))
