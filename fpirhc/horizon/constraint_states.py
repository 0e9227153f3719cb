"""Limits of other quantities than states: rates of inputs, and paths.

Each limit adds an entry z to the stage's state, z_{i+1} = c(s_i, u_i, theta_i), with bounds. So every optimiser that keeps bounds
of states keeps these limits too, and they are verified and named like states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, Mistakes
from fpirhc.horizon.cost import View
from fpirhc.horizon.horizon import Horizon
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Signal
from fpirhc.task.limits import Limits, PathConstraint


@dataclass(frozen=True, eq=False)
class ConstraintState:
    """One further entry of the stage's state."""

    name: str
    unit: str
    expression: ca.SX
    lower: float  # bound; infinite where free
    upper: float  # bound; infinite where free


def entries_of(limits: Mapping[str, PathConstraint], view: View) -> list[ConstraintState]:
    """Limited expressions of a stage as entries."""
    entries = []
    for name, one in limits.items():
        value = ca.SX(cast(Any, one.expression)(view))
        if value.numel() != 1:
            raise InvalidProblem(f"limits: path '{name}' must be one scalar, got {value.shape}")
        entries.append(ConstraintState(name, one.unit, value, one.lower, one.upper))
    return entries


def check_names(horizon: Horizon, limits: Limits) -> None:
    """Raise where a margin is that of no limited state, or leaves nothing between two limits."""
    mistakes = Mistakes("horizon")
    mistakes.unknown("margins: limit of state", horizon.margins, list(limits.states))
    for name in sorted(horizon.margins.keys() & limits.prices.keys()):
        mistakes.add(f"margins of '{name}': its limit has a price, and a margin makes it hard; leave one of them out")
    for name in horizon.margins.keys() & limits.states.keys():
        lower, upper = limits.states[name]
        if 2 * horizon.margins[name] >= upper - lower:
            mistakes.add(
                f"margins of '{name}' is {horizon.margins[name]:.6g}, which leaves nothing between its limits "
                f"{lower:g} and {upper:g}; widen the limits, or adapt faster"
            )
    mistakes.raise_if_any()


def state_prices(limits: Limits, state: Signal, plant: Plant, step: float) -> np.ndarray:
    """Price of a violation of every entry's limits at one node (ns,), in cost per unit; infinite where limits are hard."""
    prices = {f"{name} rate" if name in plant.inputs else name: step * price for name, price in limits.prices.items()}
    prices |= {as_measured(entry): price for entry, price in prices.items()}
    return np.array([prices.get(e, math.inf) for e in state.elements])


def as_measured(name: str) -> str:
    """Return the name of a state's entry whose limits hold for the measured state."""
    return f"{name} as measured"
